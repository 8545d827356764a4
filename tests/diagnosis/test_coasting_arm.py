"""Arms that coast, in closed form, with dry friction that only the bend of a curve shows; and a spring that softens."""

import dataclasses

import numpy as np
import pytest
from command_line import call
from scipy.integrate import solve_ivp
from scipy.signal import butter, lfilter

import estimators as est
import rtac_jax as rtac
from estimators.output_error.fit_what_shows import fit_what_shows
from rtac_jax.effects import (
    ArmCoulomb,
    ArmQuadraticDrag,
    CableSpring,
    CubicSpring,
    HystereticSpring,
    QuadraticSpring,
    TorqueOffset,
)
from rtac_jax.measurement import Experiment, Recording

STEP, INERTIA, VISCOUS, DRY = 0.01, 1e-3, 1.5e-4, 2.2e-3  # s, kg m^2, N m s/rad, N m
RESOLUTION = np.deg2rad(0.061)  # of a gyroscope


def coast(
    name: str,
    speed: float,
    seed: int,
    *,
    seconds: float = 2.7,
    shaken: float = 0.0,
    viscous: float = VISCOUS,
    dry: float = DRY,
) -> Experiment:
    """Record an arm that coasts from a speed [rad/s], in closed form, shaken by a nutation of some rad/s^2."""
    random = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP))
    rate, level = viscous / INERTIA, np.sign(speed) * dry / viscous
    exact = (speed + level) * np.exp(-rate * time) - level
    fine = 10
    band = lfilter(
        *butter(2, np.array([0.3, 6.6]) * 2 * STEP / fine, "band"), random.normal(size=fine * len(time) + 3000)
    )
    turned = np.cumsum(shaken * band[3000:] / np.std(band[3000:])) * STEP / fine
    read = exact + turned[::fine] + np.deg2rad(0.1) * random.normal(size=len(time))
    return Experiment.of(
        name, kind="free", sample_time=STEP, cart="clamped", arm_velocity=RESOLUTION * np.round(read / RESOLUTION)
    )


def recording(*several: Experiment) -> Recording:
    return Recording(several, rig={"arm_inertia": INERTIA})


def diagnosed(seconds: float) -> est.Diagnosis:
    """Diagnose an arm that coasted so long, shaken."""
    shaken = recording(coast("only", -12.8, 1, seconds=seconds, shaken=0.15))
    fit, held = fit_what_shows(rtac.RTAC.from_rig(shaken), shaken, progress=False)
    assert held == ("arm_viscous.positive",)
    assert fit.farthest > 50
    return est.diagnose(fit, shaken, candidates=[ArmCoulomb, ArmQuadraticDrag], progress=False)


def check_dry_friction(found: est.Diagnosis) -> None:
    """Predictions take the bend of the curve for random torques, and a few stretches of a second contradict nothing."""
    assert [c.id for c in found.effects] == ["arm_coulomb"], found
    assert found.by_simulation
    assert found.effects[0].parameters["level"].value == pytest.approx(DRY, rel=0.06)


@pytest.mark.slow
def test_what_three_stretches_of_a_second_cannot_confirm_is_asked_of_simulations() -> None:
    check_dry_friction(diagnosed(2.7))


@pytest.mark.slow
def test_what_simulations_do_not_explain_either_is_not_adequate_for_want_of_data() -> None:
    found = diagnosed(2.0)
    check_dry_friction(found)
    assert found.evidence is not None
    lost = {place: {} for place in found.evidence.simulated}
    judged = est.judge(dataclasses.replace(found.evidence, simulated=lost))
    assert judged.verdict == "unknown"
    assert judged.simulation is not None
    assert judged.simulation.cause == "unexplained"  # by random forces
    more = {n: dataclasses.replace(one, shaken=one.error) for n, one in found.evidence.simulations.items()}
    judged = est.judge(dataclasses.replace(found.evidence, simulated=lost, simulations=more))
    assert judged.simulation is not None
    assert judged.simulation.cause == "too few data"
    assert "so might arm_coulomb" in judged.simulation.words


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_of_an_arm_that_is_shaken_and_hides_nothing_nothing_is_named(seed: int) -> None:
    """With the whole catalogue: a single effect takes nine tenths off a random walk in one of four to nine of them."""
    seconds = 2.7 if seed % 2 else 2.0
    calm = recording(coast("only", -12.8, seed, seconds=seconds, shaken=0.15, viscous=4.5e-4, dry=0.0))
    fit, _ = fit_what_shows(rtac.RTAC.from_rig(calm), calm, progress=False)
    assert fit.farthest > 3, "random forces lead the simulation astray"
    found = est.diagnose(fit, calm, progress=False)
    assert (found.verdict, found.effects) == ("adequate", ()), found


@pytest.mark.slow
def test_friction_of_the_way_that_was_held_out_follows_that_of_the_other() -> None:
    """With dry friction the viscous one falls to a third, and that of the other way with it."""
    both = recording(coast("back", -12.8, 1), coast("forth", 12.8, 2))
    found = est.improve(
        rtac.RTAC.from_rig(both), both, validation=["forth"], candidates=[ArmCoulomb, ArmQuadraticDrag],
        thorough=False, progress=False,
    )  # fmt: skip
    assert [c.id for c in found.added] == ["arm_coulomb"], found
    assert not found.predicted_gains
    assert found.final.statistics["winner"] != "predictions one sample ahead"
    values = found.final.model
    assert float(values["arm_viscous.positive"]) == float(values["arm_viscous.negative"])
    assert float(values["arm_viscous.negative"]) == pytest.approx(VISCOUS, rel=0.02)
    assert float(values["arm_coulomb.level"]) == pytest.approx(DRY, rel=0.01)
    assert found.validation.models[0].errors["arm_velocity"].rms_over_noise > 20
    assert found.validation.models[-1].errors["arm_velocity"].rms_over_noise < 2


@pytest.mark.slow
def test_the_next_experiment_is_one_that_needs_no_motor() -> None:
    """A longer coast shows where dry friction brings the arm to rest, which an offset of the torque does not."""
    calm = recording(coast("only", -12.8, 1))
    fit, _ = fit_what_shows(rtac.RTAC.from_rig(calm), calm, progress=False)
    found = est.diagnose(fit, calm, candidates=[ArmCoulomb, TorqueOffset, CableSpring], progress=False)
    assert found.verdict == "ambiguous", found
    assert {c.id for c in found.effects} >= {"arm_coulomb", "torque_offset"}, (
        "a cable without stiffness is no more than these"
    )
    planned = est.next_experiment(
        fit, calm, found, between=["arm_coulomb", "torque_offset", "cable_spring"], progress=False
    )
    assert all(one.plan.kind == "free" and one.plan.current is None for one in planned.ranked)
    assert ("torque_offset", "cable_spring") not in planned.already, "a cable imitates it whatever is recorded"
    best = planned.best.plan
    assert best.initial_arm_velocity > 0 or best.duration > 8.0, "the other way, or to rest"
    assert planned.best.smallest > 100 * max(1.0, min(planned.already.values()))
    text = str(planned)
    assert "the cart clamped, the arm at 0 rad, turning at" in text
    assert "torque 0 N m, current 0 A" in text


@pytest.mark.slow
def test_a_comparison_holds_what_shows_nowhere_as_a_fit_does(tmp_path) -> None:
    recording(coast("only", -12.8, 1)).save(tmp_path / "rig.h5")
    said = call("compare", tmp_path / "rig.h5")
    assert said.exit_code == 0, said.output
    assert (
        "arm_viscous.positive: without effect on what is fitted, and held at the value of arm_viscous.negative"
        in said.stdout
    )


MASS, STIFFNESS, SOFTENS, RUBS, DAMPS = 0.791, 280.0, -7100.0, 0.37, 4.4  # kg, N/m, N/m^3, N, N s/m


def swing(name: str, position: float, speed: float, seed: int) -> Experiment:
    """Record a cart on a spring that softens by steps of 2 mm, integrated by SciPy with friction that is next to discontinuous."""
    time = STEP * np.arange(250)

    def rate(_, state):
        x, v = state
        return [v, -(STIFFNESS * x + SOFTENS * x**3 + DAMPS * v + RUBS * np.tanh(v / 1e-3)) / MASS]

    found = solve_ivp(rate, (0.0, time[-1]), [position, speed], t_eval=time, method="LSODA", rtol=1e-8, atol=1e-10)
    read = found.y[0] + 3e-4 * np.random.default_rng(seed).normal(size=len(time))
    return Experiment.of(name, kind="free", sample_time=STEP, arm="locked", cart_position=2e-3 * np.round(read / 2e-3))


@pytest.mark.slow
def test_a_spring_that_softens_is_found_though_all_of_it_would_let_the_cart_go() -> None:
    """Beside steps of 2 mm 15 % of the motion are five times the noise, and random forces as large as the spring's follow that."""
    swings = Recording([swing("small", -0.035, 0.42, 2), swing("large", -0.117, 2.56, 3)], rig={"total_mass": MASS})
    fit = est.output_error(rtac.RTAC.from_rig(swings), swings, progress=False)
    assert 3 < fit.farthest < 10
    found = est.diagnose(fit, swings, candidates=[CubicSpring, QuadraticSpring, HystereticSpring], progress=False)
    assert [c.id for c in found.effects] == ["cubic_spring"], found
    assert found.by_simulation
    assert found.effects[0].parameters["stiffness"].value == pytest.approx(SOFTENS, rel=0.05)
