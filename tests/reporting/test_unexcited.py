"""Constants of a part that never moves, which no table shows."""

import dataclasses

import numpy as np

import estimators as est
import rtac_jax as rtac
from estimators.reporting.fit_table import recommended_table
from estimators.reporting.tables import parameter_table
from estimators.validation.recommendation import Recommendation
from rtac_jax.measurement import Experiment

CART = {"total_mass", "eccentric_moment", "spring_stiffness"}


def motor() -> rtac.Recording:
    """A motor that is driven by 0.1 A on and off: J w' = k i - d w, integrated exactly."""
    step, inertia, constant, damping = 0.01, 1e-4, 0.02, 1e-3
    current = 0.1 * np.sign(np.sin(3.0 * step * np.arange(400) + 0.1))
    decay = np.exp(-damping / inertia * step)
    speed = np.zeros(400)
    for k in range(399):
        speed[k + 1] = decay * speed[k] + (1 - decay) * constant / damping * current[k]
    speed += 1e-3 * np.random.default_rng(1).standard_normal(400)
    several = [
        Experiment.of(
            f"run_{n}", kind="forced", sample_time=step, current=current[part], arm_velocity=speed[part], cart="clamped"
        )
        for n, part in enumerate((slice(200), slice(200, 400)))
    ]
    return rtac.Recording(tuple(several), rig={"arm_inertia": inertia})


def test_a_clamped_cart_has_no_constants_in_any_table() -> None:
    recording = motor()
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert fit.unexcited == CART
    assert fit.parameters.keys() >= CART, "they are parameters of the model all the same"
    shown = [row[0] for row in fit.rows()]
    assert {"arm_inertia", "torque_constant"} <= set(shown)
    assert not CART & set(shown)
    assert [row[0] for row in parameter_table(fit).rows] == shown
    advice = Recommendation(fit.parameters, "output error", "a white residual", sound=True)
    assert [row[0] for row in recommended_table(advice, fit).rows] == shown
    compared = est.compare(fit, recording)
    found = est.recommended(fit, compared.models[0])
    assert [row[0] for row in found.rows()] == shown
    tilted = dataclasses.replace(fit, model=fit.model + rtac.effects.GravityTilt(0.1, 0.0))
    assert tilted.unexcited == CART - {"eccentric_moment"}, "gravity turns the arm by its product with that"
    assert abs(fit.parameters["torque_constant"].value - 0.02) < 4 * fit.parameters["torque_constant"].std
