"""Output error of a model that may lack what would show some of its parameters."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from estimators.closed_form.fit import starting_values
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
    nowhere. Friction that way is then as the other way (`ALIKE`), which is nearer than any value that nobody estimated; where the
    fit follows nothing, as the closed form has it.

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
    fit = by(_begun_alike(model, recording, unseen).fix(*unseen), recording, **options)
    return Shown(with_alike(fit, recording, unseen), tuple(sorted(unseen)))


def _begun_alike(model: RTAC, recording: Recording, unseen: Sequence[str]) -> RTAC:
    """Return a model in which what shows nowhere has the value of the other direction in closed form: that of this rig, roughly."""
    others = _seen_the_other_way(unseen)
    if not others:
        return model
    found = starting_values(model, recording)
    return model.with_values({name: found[other] for name, other in others.items()})


def _seen_the_other_way(unseen: Sequence[str]) -> dict[str, str]:
    """Return what shows in the other direction, by name of what shows nowhere."""
    others = {name: alike_of(name) for name in unseen}
    return {name: other for name, other in others.items() if other is not None and other not in unseen}


def with_alike(fit: Fit, recording: Recording, unseen: Sequence[str]) -> Fit:
    """Return a fit in which what shows nowhere has the value of the other direction, where that shows and the fit follows.

    The friction of a model that follows nothing is of another motion.

    Args:
        fit: with these parameters held.
        recording: that was fitted.
        unseen: their names.
    """
    values = {name: fit.model[other] for name, other in _seen_the_other_way(unseen).items()}
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
    alike = _seen_the_other_way(unseen)
    several = {
        f"{'the value' if float(model[name]) == float(model[other]) else 'the first estimate'} of {other}"
        for name, other in alike.items()
    }
    return " and ".join([*sorted(several), *([values] if len(alike) < len(unseen) else [])])
