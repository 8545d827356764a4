"""Output error of a model that may lack what would show some of its parameters."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from estimators.core.fit import Fit
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit import output_error
from rtac_jax import RTAC
from rtac_jax.measurement import Recording

ALIKE = {"positive": "negative", "negative": "positive"}
"""Fields of effects that say the same of two directions."""


class Shown(NamedTuple):
    """A fit, and the names of the parameters that it held as they show nowhere."""

    fit: Fit
    unseen: tuple[str, ...]


def fit_what_shows(
    model: RTAC, recording: Recording, *, by: Callable[..., Fit] = output_error, **options: Any
) -> Shown:
    """Fit a model by output error with those parameters of effects held at their values that have no effect on its simulation.

    What the model lacks may be what would show them: without gravity a pendulum does not swing back, and friction that way is
    nowhere. Friction that way is then as the other way (`ALIKE`), which is nearer than any value that nobody estimated.

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
    fit = by(model.fix(*unseen), recording, **options)
    return Shown(dataclasses.replace(fit, model=with_alike(fit.model, unseen)), tuple(sorted(unseen)))


def with_alike(model: RTAC, unseen: Sequence[str]) -> RTAC:
    """Return a model in which parameters that show nowhere have the values of the other direction, where that is not among them."""
    others = {name: alike_of(name) for name in unseen}
    values = {n: model[o] for n, o in others.items() if o is not None and o not in unseen}
    return model.with_values(values) if values else model


def alike_of(name: str) -> str | None:
    """Return the name of the parameter that is the same one in the other direction; None for what has none."""
    effect, _, field = name.rpartition(".")
    return f"{effect}.{ALIKE[field]}" if field in ALIKE else None


def values_held(unseen: Sequence[str], values: str) -> str:
    """Say at which values parameters are held that show nowhere.

    Args:
        unseen: their names.
        values: those of what has no other direction, in words.
    """
    several = {other for name in unseen if (other := alike_of(name)) is not None and other not in unseen}
    others = [values] if len(several) < len(unseen) else []
    return " and ".join([*(f"the value of {one}" for one in sorted(several)), *others])
