"""A base model that lacks what would show one of its parameters is fitted without that, and not refused."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import estimators as est
import rtac_jax as rtac
from estimators.core.results import NotIdentifiableError
from estimators.output_error.fit_what_shows import fit_what_shows, values_held
from rtac_jax.effects import ArmCoulomb, CurrentOffset, GravityTilt
from rtac_jax.measurement import Experiment, Recording

STEP = 2 * np.pi / 2048  # of an encoder
# Of an arm that a motor lifts: inertia [kg m^2], its friction [N m s/rad], and gain and gravity over the inertia.
INERTIA, LIFTED_FRICTION, LIFTED_GAIN, LIFTED_GRAVITY = 1e-4, 1.9e-3, 430.0, 100.0
MOMENT = float(rtac.RTAC.paper()["eccentric_moment"])
GRAVITY, FRICTION = 120.9, 0.11  # torque and viscous friction of an inertia of 1 kg m^2


def lifted_arms() -> Recording:
    """Arms in a vertical plane that a pulse of current lifts and that fall back, read to a degree every 2 ms."""
    time, several = 2e-3 * np.arange(650), []
    for name, level in (("up", 1.0), ("half", 0.6), ("down", -0.8)):
        current = np.where((time >= 0.1) & (time < 0.25), level, 0.0)

        def rates(t: float, x: np.ndarray, current: np.ndarray = current) -> list[float]:
            now = current[min(int(t / 2e-3 + 1e-9), len(current) - 1)]
            friction = LIFTED_FRICTION / INERTIA * x[1]
            return [x[1], LIFTED_GAIN * now - friction - LIFTED_GRAVITY * np.sin(x[0])]

        moved = solve_ivp(
            rates, (0.0, time[-1]), [0.0, 0.0], rtol=1e-9, atol=1e-11, t_eval=time, max_step=2e-3, method="DOP853"
        ).y[0]
        read = np.deg2rad(np.round(np.rad2deg(moved)))
        several.append(
            Experiment.of(
                name, kind="forced", sample_time=2e-3, cart="clamped", arm_angle=read, current=current,
                initial_arm_angle=0.0,
            )
        )  # fmt: skip
    return Recording(several, {"arm_inertia": INERTIA})


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


def test_of_a_fit_that_follows_nothing_it_is_held_as_the_closed_form_has_the_other_way() -> None:
    """The fit without gravity has friction of a hundred times the arm's own, and the paper's is that of another rig."""
    recording = lifted_arms().select(["up", "half"])
    fit, unseen = fit_what_shows(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert unseen == ("arm_viscous.negative",)
    assert fit.farthest > 20.0, "it does not follow"
    held = float(fit.model["arm_viscous.negative"])
    assert 0.3 < held / LIFTED_FRICTION < 3.0
    assert held != float(fit.model["arm_viscous.positive"])
    said = values_held(fit.model, unseen, "its values")
    assert said == "the first estimate of arm_viscous.positive"


@pytest.mark.slow
def test_gravity_is_named_where_the_fit_without_it_follows_nothing() -> None:
    """Its parameters are those of another motion; "adequate" had been the verdict, at 51 times the noise."""
    recording = lifted_arms()
    found = est.improve(
        rtac.RTAC.from_rig(recording), recording, validation=["down"], candidates=[GravityTilt, ArmCoulomb, CurrentOffset],
        progress=False,
    )  # fmt: skip
    assert [c.id for c in found.added] == ["gravity_tilt"], found.headline
    assert found.mended == "adequate"
    across = found.final.parameters["gravity_tilt.across"]
    assert across.value == pytest.approx(LIFTED_GRAVITY * INERTIA / (9.80665 * MOMENT), rel=0.02)
    assert found.final.parameters["torque_constant"].value == pytest.approx(LIFTED_GAIN * INERTIA, rel=0.02)
    assert max(e.rms_over_noise for e in found.validation.models[-1].errors.values()) < 2.0


def test_values_at_which_parameters_are_held() -> None:
    model = rtac.RTAC.paper()
    one, two = "arm_viscous.negative", "arm_viscous.positive"
    alike = model.with_values({one: model[two]})
    apart = model.with_values({one: 2 * model[two]})
    assert values_held(alike, (one,), "its values") == "the value of arm_viscous.positive"
    assert values_held(apart, (one,), "its values") == "the first estimate of arm_viscous.positive"
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
