"""Output error of a model that may lack what would show some of its parameters."""

from typing import Any

from estimators.core.fit import Fit
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit import output_error
from rtac_jax import RTAC
from rtac_jax.measurement import Recording


def fit_what_shows(model: RTAC, recording: Recording, **options: Any) -> Fit:
    """Fit a model by output error with those parameters of effects held at their values that have no effect on its simulation.

    What the model lacks may be what would show them: without gravity a pendulum does not swing back, and friction that way is
    nowhere.

    Args:
        model: as `output_error` takes it, and so `recording`.
        recording: with moving experiments.
        options: of `output_error`.

    Raises:
        NotIdentifiableError: anything else is free, or no parameter is left.
        ValueError, DivergedError: as `output_error`.
    """
    try:
        return output_error(model, recording, **options)
    except NotIdentifiableError as error:
        if not error.unseen:
            raise
        shown = model.fix(*error.unseen)
    return output_error(shown, recording, **options)


def held_unseen(model: RTAC, fit: Fit) -> tuple[str, ...]:
    """Return the names of the parameters of a model that its fit held as they show nowhere."""
    return tuple(sorted(set(model.free) - set(fit.model.free)))
