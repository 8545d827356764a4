"""The parts of the paper's model that a recording excites."""

import numpy as np

from rtac_jax.measurement import Recording


def excited_parts(recording: Recording) -> tuple[frozenset[str], frozenset[str]]:
    """Return what moves, of "arm" and "cart", and the names of the constants that nothing excites.

    Raises:
        ValueError: nothing moves in the recording.
    """
    moving = [e for e in recording.experiments if e.kind != "rest"]
    if not moving:
        raise ValueError("the recording holds rest records only; add an experiment in which the rig moves.")
    if all(e.arm == "locked" and e.cart == "clamped" for e in moving):
        raise ValueError("arm and cart are both held in every experiment; add one in which either moves.")
    arm = any(e.arm == "free" for e in moving)
    cart = any(e.cart == "free" for e in moving)
    driven = any("current" in e.inputs and np.any(e.inputs["current"].values != 0) for e in moving)
    unexcited: set[str] = set()
    if not arm:
        unexcited |= {"arm_inertia", "eccentric_moment", "torque_constant"}
    if not cart:
        unexcited |= {"total_mass", "eccentric_moment", "spring_stiffness"}
    if not driven:
        unexcited.add("torque_constant")
    return frozenset(name for name, moves in (("arm", arm), ("cart", cart)) if moves), frozenset(unexcited)
