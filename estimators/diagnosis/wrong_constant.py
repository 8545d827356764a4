"""Wrong constants as candidates of a diagnosis, beside the effects that look like them."""

from collections.abc import Iterable, Sequence

from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.effects.wrong_constant import WRONG_CONSTANTS

# Of the constants that these change one fixes the scale of all others, and no motion shows what it is itself.
_SCALES = ("total_mass", "arm_inertia", "spring_stiffness", "torque_constant", "eccentric_moment")
_OF = {c.id: name for name, c in WRONG_CONSTANTS.items()}


_RATIO = ("total_mass", "arm_inertia")  # where these two alone are exact, no motion shows more than their ratio


def wrong_constants(model: RTAC) -> list[type[Effect]]:
    """Return the candidates for constants that the model takes as exact; none where all but one are estimated.

    A constant with a standard deviation is estimated, and so it is no candidate: what its error may change is no sign of
    anything else. Where mass and inertia alone are exact, an error of either is the same, and the inertia stands for both.
    """
    held = _held(model)
    if len(held) < 2:
        return []
    several = held[1:] if held == list(_RATIO) else held
    return [c for name, c in WRONG_CONSTANTS.items() if name in several and c.id not in model]


def doubt(ids: Sequence[str], model: RTAC) -> str:
    """Say what decides where a wrong constant is among the effects that are named; nothing where none is.

    Args:
        ids: of the effects.
        model: that was diagnosed.
    """
    names = [_OF[i] for i in dict.fromkeys(ids) if i in _OF]
    if not names:
        return ""
    if _held(model) == list(_RATIO):
        names = list(_RATIO)
    stds = " and ".join(f"{name}_std" for name in names)
    return (
        f" Wrong constant: {' or '.join(names)} is taken as exact and need not be. If nothing else tells it apart, no motion of"
        f" the rig will: measure it again, or state how sure it is ({stds} in /rig), and ask again."
    )


def without_constants(group: Iterable[str]) -> bool:
    """Return whether two effects of a group that look alike, by id, are no wrong constants, so that an experiment may tell them."""
    return sum(i not in _OF for i in group) > 1


def stands_for(ids: Sequence[str], model: RTAC) -> str:
    """Say which constants a candidate stands for that is named; nothing where that is the one of its name.

    Args:
        ids: of the effects that are named.
        model: that was diagnosed.
    """
    named = next((i for i in ids if i in _OF), None)
    if named is None or _held(model) != list(_RATIO):
        return ""
    return (
        f" {named} stands for an error of {' or of '.join(_RATIO)}, which no motion tells apart: weigh the cart again."
    )


def _held(model: RTAC) -> list[str]:
    return [name for name in _SCALES if name in model.fixed]
