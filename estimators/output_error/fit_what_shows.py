"""Output error of a model that may lack what would show some of its parameters."""

from collections.abc import Callable
from typing import Any, NamedTuple

from estimators.core.fit import Fit
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit import output_error
from rtac_jax import RTAC
from rtac_jax.measurement import Recording


class Shown(NamedTuple):
    """A fit, and the names of the parameters that it held as they show nowhere."""

    fit: Fit
    unseen: tuple[str, ...]


def fit_what_shows(
    model: RTAC, recording: Recording, *, by: Callable[..., Fit] = output_error, **options: Any
) -> Shown:
    """Fit a model by output error with those parameters of effects held at their values that have no effect on its simulation.

    What the model lacks may be what would show them: without gravity a pendulum does not swing back, and friction that way is
    nowhere.

    Args:
        model: as `output_error` takes it, and so `recording`.
        recording: with moving experiments.
        by: output error.
        options: of that.

    Raises:
        NotIdentifiableError: anything else is free, or no parameter is left.
        ValueError, DivergedError: as `output_error`.
    """
    try:
        return Shown(by(model, recording, **options), ())
    except NotIdentifiableError as error:
        if not error.unseen:
            raise
        unseen = error.unseen
    return Shown(by(model.fix(*unseen), recording, **options), tuple(sorted(unseen)))
