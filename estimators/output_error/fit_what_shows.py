"""Output error of a model that may lack what would show some of its parameters."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from estimators.core.data import CHANNELS, Data, motion_of, moving, pieces
from estimators.core.fit import Fit
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit import output_error
from rtac_jax import RTAC
from rtac_jax.measurement import Recording

ALIKE = {"positive": "negative", "negative": "positive"}
"""Fields of effects that say the same of two directions."""
_FOLLOWED = 0.25  # of a channel's motion, that a model leaves which follows it


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
    return Shown(with_alike(fit, recording, unseen), tuple(sorted(unseen)))


def with_alike(fit: Fit, recording: Recording, unseen: Sequence[str]) -> Fit:
    """Return a fit in which what shows nowhere has the value of the other direction, where that shows and the fit follows.

    The friction of a model that follows nothing is of another motion.

    Args:
        fit: with these parameters held.
        recording: that was fitted.
        unseen: their names.
    """
    others = {name: alike_of(name) for name in unseen}
    values = {n: fit.model[o] for n, o in others.items() if o is not None and o not in unseen}
    if not values:
        return fit
    motion = dict(zip(CHANNELS, motion_of(Data.of(pieces(moving(recording)))).tolist(), strict=True))
    if any(left > _FOLLOWED * motion[channel] for channel, left in fit.residual_std.items()):
        return fit
    return dataclasses.replace(fit, model=fit.model.with_values(values))


def alike_of(name: str) -> str | None:
    """Return the name of the parameter that is the same one in the other direction; None for what has none."""
    effect, _, field = name.rpartition(".")
    return f"{effect}.{ALIKE[field]}" if field in ALIKE else None


def values_held(model: RTAC, unseen: Sequence[str], values: str) -> str:
    """Say at which values of a model parameters are held that show nowhere.

    Args:
        model: that was fitted.
        unseen: their names.
        values: those that are not of the other direction, in words.
    """
    alike = {name: other for name in unseen if (other := alike_of(name)) is not None and other not in unseen}
    several = {other for name, other in alike.items() if float(model[name]) == float(model[other])}
    others = [values] if len(several) < len(unseen) else []
    return " and ".join([*(f"the value of {one}" for one in sorted(several)), *others])
