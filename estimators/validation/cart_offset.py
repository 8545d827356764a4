"""An offset of the cart's position: a place around which it moves, and where the spring is not at rest."""

from collections.abc import Mapping, Sequence

import numpy as np

from estimators.validation.equilibrium import ONE_SIDED, is_held
from rtac_jax.measurement import Experiment

# A plane that is off level by two degrees shows to the eye; an offset beyond what it gives, g sin(2 deg) / (k / (M+m)), is no tilt.
LEVEL = 9.81 * np.sin(np.deg2rad(2.0))
OFFSET = "offset of cart_position"
_PULLED = (
    "; where it has none, gravity on a slide or a spring that is stiffer on one side does it, which est.diagnose names"
)


def offset_of_all(coefficients: Mapping[str, float], experiments: Sequence[Experiment]) -> float | None:
    """Return around which place the cart of all experiments moves [m], if further off than a tilted plane can bring it.

    Of a stiff spring that is next to nothing beside the motion, and shifts by as much if it is softer on one side or hysteretic.

    Args:
        coefficients: of the equations divided by M+m, as `equation_error.COEFFICIENTS` names them.
        experiments: all of them.
    """
    longest = max(e.sample_time * e.samples for e in experiments)
    positions = [e.outputs["cart_position"].values for e in experiments if "cart_position" in e.outputs]
    amplitude = max((np.sqrt(2) * float(np.nanstd(values)) for values in positions), default=0.0)
    push = coefficients["offset"] - coefficients["against_offset"]
    if coefficients["spring"] <= 0 or abs(push) < LEVEL or not is_held(coefficients["spring"], longest):
        return None
    # The equation is q'' + k/(M+m) (q - offset) = 0, so the constant is less the offset's fraction of the spring.
    off = -push / coefficients["spring"]
    return off if abs(off) > ONE_SIDED * amplitude else None


def of_all(off: float) -> str:
    """Say that the cart of all experiments moves around another place than zero [m], and what to do."""
    return (
        f"all experiments: the cart moves around {1e3 * off:.3g} mm instead of 0, further than a plane 2 degrees off level "
        f"would bring it: cart_position has an offset; {taken_off(off)}{_PULLED}."
    )


def of_one(name: str, off: float) -> str:
    """Say that the cart of one experiment, by its name, moves around another place than that of the others [m]."""
    return (
        f"experiment {name}: its cart moves around a place {1e3 * off:.3g} mm from where the spring of the others is at rest, "
        f"further than dry friction can hold it: cart_position has an offset; {taken_off(off)}; or its spring is not that of the"
        " others."
    )


def taken_off(off: float) -> str:
    """Say how to take an offset [m] away."""
    how = f"subtract {off:.4g} m from" if off > 0 else f"add {-off:.4g} m to"
    return f"{how} cart_position, or read it from where the spring is at rest"
