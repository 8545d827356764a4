"""A small recording whose experiments differ in length, sample time and channels."""

import dataclasses
import functools

import numpy as np

from rtac_jax import virtual_rig
from rtac_jax.measurement import Recording
from rtac_jax.virtual_rig import Plan, Rig

RIG = Rig(encoder=True)
TRUTH = {
    "spring_stiffness": RIG.spring_stiffness, "cart_coulomb.level": RIG.cart_coulomb,
    "cart_viscous.coefficient": RIG.cart_viscous, "eccentric_moment": RIG.eccentric_moment,
    "torque_constant": RIG.torque_constant, "arm_viscous.positive": RIG.arm_viscous_positive,
    "arm_viscous.negative": RIG.arm_viscous_negative,
}  # fmt: skip
# Duration [s], sample time [s], and the channels that were not measured.
_RUNS = {
    "free_1": (6.0, 0.005, ()),
    "free_2": (4.0, 0.01, ("arm_velocity",)),
    "forced_1": (8.0, 0.01, ()),
    "forced_2": (6.0, 0.005, ("arm_velocity",)),
    "forced_3": (7.0, 0.01, ()),
    "rest_1": (2.0, 0.005, ()),
}


@functools.cache
def unequal() -> Recording:
    """Two free and three forced runs and a rest, at 5 and 10 ms, the shortest half as long as the longest."""
    found = virtual_rig.record(RIG, [_plan(name, *run[:2]) for name, run in _RUNS.items()], seed=2)
    kept = [
        dataclasses.replace(e, outputs={c: s for c, s in e.outputs.items() if c not in _RUNS[e.name][2]}) for e in found
    ]
    return Recording(tuple(kept), rig=found.rig)


def _plan(name: str, duration: float, sample_time: float) -> Plan:
    plans = virtual_rig.standard_plans(seed=1, duration=duration, sample_time=sample_time, free=2, forced=3)
    return next(plan for plan in plans if plan.name == name)


def near(one: object, other: object, *, rtol: float = 1e-8) -> None:
    """Equal to this share of the largest."""
    one, other = np.asarray(one), np.asarray(other)
    assert np.all(np.isfinite(one))
    np.testing.assert_allclose(one, other, rtol=rtol, atol=rtol * max(np.max(np.abs(other), initial=0.0), 1e-300))
