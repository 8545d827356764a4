"""A base model that lacks what would show one of its parameters is fitted without that, and not refused."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import estimators as est
import rtac_jax as rtac
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit_what_shows import fit_what_shows, values_held
from rtac_jax.measurement import Experiment, Recording

STEP = 2 * np.pi / 2048  # of an encoder
GRAVITY, FRICTION = 120.9, 0.11  # torque and viscous friction of an inertia of 1 kg m^2


def slowing_arms() -> Recording:
    """Arms that turn one way and slow down, in closed form."""
    time = 0.01 * np.arange(300)
    several = []
    for n, speed in enumerate((20.0, 35.0)):
        angle = speed / 0.8 * (1 - np.exp(-0.8 * time))
        read = np.round(angle / STEP) * STEP
        several.append(Experiment.of(f"run_{n}", kind="free", sample_time=0.01, cart="clamped", arm_angle=read))
    return Recording(several, {"arm_inertia": 1.0})


def test_what_shows_nowhere_is_held() -> None:
    recording = slowing_arms()
    model = rtac.RTAC.from_rig(recording)
    with pytest.raises(NotIdentifiableError, match="has no effect on what was measured") as refused:
        est.output_error(model, recording, progress=False)
    assert refused.value.unseen == ("arm_viscous.negative",)
    fit, unseen = fit_what_shows(model, recording, progress=False)
    assert unseen == ("arm_viscous.negative",)
    found, other = (fit.parameters[f"arm_viscous.{way}"] for way in ("positive", "negative"))
    assert (other.value, other.std) == (found.value, 0.0), (
        "the friction of the other way is the nearest that anybody knows"
    )
    assert abs(found.value - 0.8) < 3 * found.std < 0.01


def test_values_at_which_parameters_are_held() -> None:
    model = rtac.RTAC.paper()
    one, two = "arm_viscous.negative", "arm_viscous.positive"
    alike = model.with_values({one: model[two]})
    apart = model.with_values({one: 2 * model[two]})
    assert values_held(alike, (one,), "its values") == "the value of arm_viscous.positive"
    assert values_held(apart, (one,), "its values") == "its values"
    assert values_held(alike, (one, two), "its values") == "its values"
    both = values_held(alike, (one, "cart_coulomb.level"), "its values")
    assert both == "the value of arm_viscous.positive and its values"


def test_what_may_be_scaled_together_is_refused_as_before() -> None:
    recording = Recording(slowing_arms().experiments)
    with pytest.raises(NotIdentifiableError, match="scaled together") as refused:
        fit_what_shows(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert refused.value.unseen == ()


@pytest.mark.slow
def test_a_pendulum_is_told_by_its_decays_alone() -> None:
    """Without gravity the base model does not swing back, and shows friction of one direction only."""
    time = 0.016 * np.arange(131)
    several = []
    for n, (angle, speed) in enumerate(((0.015, 0.6), (-0.05, 0.35))):
        swung = solve_ivp(
            lambda _, x: [x[1], -GRAVITY * np.sin(x[0]) - FRICTION * x[1]], (0.0, time[-1]), [angle, speed],
            method="DOP853", rtol=1e-11, atol=1e-13, t_eval=time,
        ).y[0]  # fmt: skip
        read = np.round(swung / STEP) * STEP
        several.append(Experiment.of(f"run_{n}", kind="free", sample_time=0.016, cart="clamped", arm_angle=read))
    recording = Recording(several, {"arm_inertia": 1.0})
    with pytest.raises(NotIdentifiableError):
        est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    (added,) = found.added
    assert "gravity_tilt" in (added.id, *added.confusable_with), found.headline
    assert found.unseen == ()
    both = [found.final.parameters[f"arm_viscous.{way}"].value for way in ("positive", "negative")]
    assert np.mean(both) == pytest.approx(FRICTION, rel=0.1)  # apart they are not told from so small a swing
    assert max(e.rms_over_noise for e in found.validation.models[-1].errors.values()) < 1.5
    assert found.base.model.fixed - found.final.model.fixed == {"arm_viscous.negative"}


@pytest.mark.slow
def test_a_pendulum_whose_noise_nobody_knows_is_not_adequate_without_gravity() -> None:
    """Its predictions may call the motion noise, and no random forces explain what its simulation misses; a simulation names it."""
    time = 0.025 * np.arange(300)
    swung = solve_ivp(
        lambda _, x: [x[1], -40.0 * np.sin(x[0]) - 0.25 * np.tanh(x[1] / 1e-3) - 0.03 * x[1]], (0.0, time[-1]), [0.3, 0.0],
        method="LSODA", rtol=1e-9, atol=1e-11, t_eval=time,
    ).y[0]  # fmt: skip
    read = swung + 0.015 * np.random.default_rng(3).normal(size=300)
    decay = Experiment.of("decay", kind="free", sample_time=0.025, cart="clamped", arm_angle=read)
    recording = Recording((decay,), {"arm_inertia": 0.01})
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert found.added, found.headline
    assert "gravity_tilt" in {i for c in found.added for i in (c.id, *c.confusable_with)}
    assert max(e.rms_over_noise for e in found.validation.models[-1].errors.values()) < 2.0
