"""The truth that closed forms are held against: the virtual rig, what they estimate of it, and recordings of it."""

import dataclasses

import estimators as est
import rtac_jax as rtac
from estimators.closed_form.two_stage import Estimates
from rtac_jax import virtual_rig

RIG = virtual_rig.Rig()
TRUTH = {
    "(M+m)/k": RIG.total_mass / RIG.spring_stiffness,
    "v/k": RIG.cart_viscous / RIG.spring_stiffness,
    "d/k": RIG.cart_coulomb / RIG.spring_stiffness,
    "eccentric_moment": RIG.eccentric_moment,
    "torque_constant": RIG.torque_constant,
    "arm_viscous.positive": RIG.arm_viscous_positive,
    "arm_viscous.negative": RIG.arm_viscous_negative,
}


def every(found: est.ClosedForm) -> dict[str, Estimates]:
    return {**found.ratios, **found.estimates}


def recorded(seed: int, *, free: int = 10, forced: int = 20, force: float = 0.0, torque: float = 0.0) -> rtac.Recording:
    """Free and forced oscillation; the drive, which makes the random torque, is off in free oscillation."""
    plans = virtual_rig.standard_plans(seed=seed, free=free, forced=forced, rest=1, duration=10.0, sample_time=0.005)
    idle = [p for p in plans if p.kind != "forced"]
    driven = [p for p in plans if p.kind == "forced"]
    rig = dataclasses.replace(RIG, force_noise=force)
    jobs = [(rig, idle, seed), (dataclasses.replace(rig, torque_noise=torque), driven, seed + 1000)]
    parts = virtual_rig.record_many(jobs)
    return rtac.Recording(tuple(e for part in parts for e in part.experiments), rig=parts[0].rig)
