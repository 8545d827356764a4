"""Where nothing shows the arm but how it pushes the cart, a fit finds it all the same."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

RIG = dataclasses.replace(virtual_rig.Rig(), eccentric_moment=3e-3, arm_inertia=2.1e-4)


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    """A strongly coupled rig without tachometer and encoder, whose arm is set by hand to a known angle."""
    plans = virtual_rig.standard_plans(seed=4, sample_time=0.005, duration=4.0, free=1, forced=2, rest=1)
    made = virtual_rig.record(RIG, plans, seed=5)
    cart = tuple(
        dataclasses.replace(e, outputs={"cart_position": e.outputs["cart_position"]}, initial_arm_angle_std=0.01)
        for e in made.experiments
    )
    return dataclasses.replace(made, experiments=cart, rig={"total_mass": RIG.total_mass})


@pytest.mark.parametrize(
    "estimator", [est.output_error, pytest.param(est.prediction_error_nonlinear, marks=pytest.mark.slow)]
)
def test_the_arm_is_found_from_how_it_pushes_the_cart(recording: rtac.Recording, estimator) -> None:
    found = estimator(rtac.RTAC.from_rig(recording), recording, progress=False).parameters
    truth = {
        "arm_inertia": RIG.arm_inertia,
        "eccentric_moment": RIG.eccentric_moment,
        "spring_stiffness": RIG.spring_stiffness,
        "torque_constant": RIG.torque_constant,
        "arm_viscous.positive": RIG.arm_viscous_positive,
    }
    for name, value in truth.items():
        assert abs(found[name].value - value) < 4 * found[name].std, name
        assert found[name].std < 0.3 * value, name
    assert np.isfinite(found["cart_coulomb.level"].std)
