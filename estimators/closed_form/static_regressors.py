"""The terms that an effect adds to the equations along the measured motion, if it depends on the motion at one instant."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from rtac_jax.effects import Actuator, DryFriction, Effect, Force, Motion

Values = Float[np.ndarray, " sample"]

_LINEAR = 1e-6  # relative difference below which half an effect is the effect at half its size
_SIZES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # times the plausible size, of an effect that is not in proportion to it


class Added(NamedTuple):
    """The terms that an effect adds to both equations of motion.

    Attributes:
        cart: force on the cart at each sample [N].
        arm: torque on the arm at each sample [N m].
    """

    cart: Values
    arm: Values

    @property
    def sound(self) -> bool:
        """Return whether it adds anything, and numbers only."""
        return all(np.all(np.isfinite(part)) for part in self) and any(np.any(part) for part in self)

    def over(self, size: float) -> "Added":
        """Return it divided by a size."""
        return Added(self.cart / size, self.arm / size)

    def is_half_of(self, other: "Added") -> bool:
        """Return whether it is half of another, but for rounding."""
        pairs = zip(self, other, strict=True)
        return all(np.linalg.norm(2 * np.asarray(a) - b) <= _LINEAR * np.linalg.norm(b) for a, b in pairs)


@dataclasses.dataclass(frozen=True)
class Regressor:
    """One candidate as it enters a linear regression.

    Attributes:
        instance: the effect at a plausible size.
        amplitudes: that are estimated; empty for an effect that is not in proportion to them, which is tried at this size.
        parts: what it adds per unit of each amplitude; of the latter, what it adds.
        holds: whether it is dry friction of the arm, which takes up whatever drives an arm that rests.
    """

    instance: Effect
    amplitudes: tuple[str, ...]
    parts: tuple[Added, ...]
    holds: bool = False


def is_static(effect: type[Effect]) -> bool:
    """Return whether a class is a force, a dry friction or a stage of the drive, and has no states of its own."""
    return not effect.states and issubclass(effect, (Force, DryFriction, Actuator))


def added_along(effect: Effect, motion: Motion, rests: Bool[np.ndarray, " sample"]) -> Added:
    """Return what a static effect adds along a motion.

    Args:
        effect: at its size.
        motion: as measured, one element per sample.
        rests: samples at which the arm does: what its dry friction is there depends on what drives it.

    Raises:
        TypeError: the effect is not static.
    """
    zero = np.zeros(len(rests))

    def full(values: ArrayLike) -> Values:
        return zero + np.asarray(values, dtype=float)

    if isinstance(effect, Actuator):
        more = full(effect.current(motion.current, ())) - full(motion.current)
        return Added(zero, float(motion.body.torque_constant) * more)
    if isinstance(effect, DryFriction):
        cart, arm = (full(level) for level in effect.levels(motion, ()))
        turn = np.where(rests, 0.0, np.sign(full(motion.arm_velocity)))
        return Added(-cart * np.sign(full(motion.cart_velocity)), -arm * turn)
    if isinstance(effect, Force):
        cart, arm = (full(value) for value in effect.force(motion, ()))
        return Added(cart, arm)
    raise TypeError(f"{effect.id} has no force that is a function of the motion.")


def regressors_of(instance: Effect, motion: Motion, rests: Bool[np.ndarray, " sample"]) -> list[Regressor]:
    """Return the regressors of an effect of plausible size.

    One, if it is in proportion to its amplitudes; else one for each of a few sizes. None where it has states of its own, sits in
    a sensor, or adds nothing to the equations of motion; and none of what changes a mass or an inertia, which sets the scale of an
    equation: with less of it all errors are smaller, and nothing is explained.

    Args:
        instance: the effect.
        motion: as measured, one element per sample.
        rests: samples at which the arm does.
    """
    if not is_static(type(instance)):
        return []
    if isinstance(instance, Force) and (np.any(instance.cart_mass()) or np.any(instance.arm_inertia(motion.body))):
        return []
    names = type(instance).amplitudes()
    holds = isinstance(instance, DryFriction) and bool(np.any(np.asarray(instance.levels(motion, ())[1])))

    def at(factors: Mapping[str, float]) -> Added:
        return added_along(_resized(instance, factors), motion, rests)

    def alone(name: str, factor: float) -> Added:
        return at({n: factor if n == name else 0.0 for n in names})

    whole = {name: alone(name, 1.0) for name in names}
    if all(alone(name, 0.5).is_half_of(whole[name]) for name in names):
        parts = tuple(whole[name].over(float(np.asarray(getattr(instance, name)))) for name in names)
        return [Regressor(instance, names, parts, holds)] if holds or all(part.sound for part in parts) else []
    sized = [(_resized(instance, dict.fromkeys(names, size)), at(dict.fromkeys(names, size))) for size in _SIZES]
    return [Regressor(one, (), (added,), holds) for one, added in sized if added.sound]


def _resized(instance: Effect, factors: Mapping[str, float]) -> Effect:
    """Return an effect whose amplitudes are multiplied by these factors."""
    sizes = {name: factor * np.asarray(getattr(instance, name)) for name, factor in factors.items()}
    return dataclasses.replace(instance, **sizes)
