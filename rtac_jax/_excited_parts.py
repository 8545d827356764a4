"""The parts of the paper's model that a recording excites."""

import numpy as np

from rtac_jax.effects import ArmViscous, CartCoulomb, CartViscous, Effect
from rtac_jax.measurement import Recording


def excited_parts(recording: Recording) -> tuple[list[Effect], set[str]]:
    """Return the friction of what moves, at the paper's values, and the names of the constants that nothing excites.

    Raises:
        ValueError: nothing moves in the recording.
    """
    moves = [e for e in recording.experiments if e.kind != "rest"]
    if not moves:
        raise ValueError("the recording holds rest records only; add an experiment in which the rig moves.")
    if all(e.arm == "locked" and e.cart == "clamped" for e in moves):
        raise ValueError("arm and cart are both held in every experiment; add one in which either moves.")
    arm = any(e.arm == "free" for e in moves)
    cart = any(e.cart == "free" for e in moves)
    driven = any("current" in e.inputs and np.any(e.inputs["current"].values != 0) for e in moves)
    effects: list[Effect] = []
    if cart:
        effects += [CartViscous(0.5543), CartCoulomb(0.024)]
    if arm:
        effects.append(ArmViscous(1.39e-4, 1.49e-4))
    unexcited: set[str] = set()
    if not arm:
        unexcited |= {"arm_inertia", "eccentric_moment", "torque_constant"}
    if not cart:
        unexcited |= {"total_mass", "eccentric_moment", "spring_stiffness"}
    if not driven:
        unexcited.add("torque_constant")
    return effects, unexcited
