"""A simulation error beyond a known noise is never called adequate, unless random forces of modest size explain it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import stepwise_selection
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.step import Step
from estimators.diagnosis.stepwise_selection import Tried
from estimators.diagnosis.verdict import judge
from estimators.inference.simulation_residual import SimulationResidual, known_noise, simulation_residual
from estimators.misspecification.adequacy import adequacy_tests
from estimators.misspecification.findings import Findings
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.measurement import Recording

SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}
NAN = float("nan")
# Before a verdict is "unknown" every look is taken at all that is offered, and the whole catalogue takes minutes.
FEW = tuple(CATALOGUE[name] for name in ("arm_coulomb", "cubic_spring", "current_lag", "tacho_gain"))
OFFERED = pytest.mark.parametrize("offered", [FEW, pytest.param(None, marks=pytest.mark.slow)], ids=["few", "whole"])


def judged(
    error: float,
    shaken: float | None,
    *,
    random: tuple[float, float] = (0.02, 0.04),
    signal: float = 200.0,
    suspect: str = "",
    experiments: int = 3,
) -> SimulationResidual:
    return simulation_residual(
        {"cart_position": 1.0, "arm_velocity": error},
        {} if shaken is None else {"cart_position": 1.0, "arm_velocity": shaken},
        {"cart_position": 300.0, "arm_velocity": signal},
        random=random, samples_per_radian=20.0, experiments=experiments, suspect=suspect, seconds=4,
    )  # fmt: skip


def test_within_twice_the_power_of_the_noise_nothing_is_said() -> None:
    assert judged(1.4, 1.0).cause == "noise"
    assert judged(1.4, 1.0).words == ""
    assert judged(1.5, 1.0, experiments=30).cause == "unexplained"


def test_random_forces_that_would_leave_ten_times_more_do_not_act() -> None:
    found = judged(17.0, 350.0, signal=2000.0)
    assert found.cause == "unexplained"
    assert found.overstated
    assert "would leave 3.5e+02 times the noise, far more, so no such forces act" in found.words
    assert judged(17.0, 120.0, signal=2000.0).cause == "shaken"
    assert not judged(17.0, 2.0, signal=2000.0).overstated


def test_modest_random_forces_that_would_leave_as_much_explain_it() -> None:
    found = judged(4.0, 5.0)
    assert found.cause == "shaken"
    assert not found.vetoes
    assert "nothing is missing" in found.words
    assert "4 times the known noise" in found.words


def test_random_forces_do_not_explain_far_more_than_they_would_leave() -> None:
    assert judged(9.0, 5.0, experiments=3).cause == "shaken"
    assert judged(9.0, 5.0, experiments=30).cause == "unexplained"  # the more experiments, the surer
    assert judged(30.0, 5.0, signal=2000.0).vetoes


def test_large_random_forces_beside_a_poor_simulation_stand_in_for_the_physics() -> None:
    assert judged(60.0, 90.0, random=(0.4, 0.0)).cause == "stand-in"
    assert judged(15.0, 20.0, random=(0.4, 0.0)).cause == "shaken"  # the simulation follows nine tenths
    assert judged(60.0, 90.0, random=(0.02, 0.04)).cause == "shaken"  # as where an arm tumbles
    words = judged(60.0, 90.0, random=(0.4, 0.0)).words
    assert "a sign, a unit, a constant" in words
    assert "or the rig is shaken as hard as that, which these data cannot tell from it" in words


@pytest.mark.parametrize(
    ("random", "error", "cause"),
    [((0.0, 0.6), 30.0, "stand-in"), ((0.0, 0.6), 15.0, "noise"), ((0.0, 0.02), 30.0, "noise")],
)
def test_a_channel_of_unknown_noise_tells_of_random_forces_in_place_of_the_physics(
    random: tuple[float, float], error: float, cause: str
) -> None:
    """As an encoder's beside a cart's sensor that was recorded at rest."""
    found = simulation_residual(
        {"cart_position": 1.2, "arm_angle": error}, {"cart_position": 9.0, "arm_angle": 9.0},
        {"cart_position": 300.0, "arm_angle": 200.0}, random=random, samples_per_radian=20.0, experiments=3,
        unknown=["arm_angle"],
    )  # fmt: skip
    assert found.cause == cause
    assert found.channel == ("arm_angle" if cause == "stand-in" else "cart_position")
    assert ("15 % of the motion away from the recording (arm_angle)" in found.words) == (cause == "stand-in")
    assert "known noise" not in found.words
    assert ("15 % of the motion" in found.headline) == (cause == "stand-in")


def test_an_effect_that_the_data_are_too_few_to_confirm_vetoes() -> None:
    found = judged(2.5, 2.8, suspect="arm_coulomb (127, the alarm is at 20)")
    assert found.cause == "too few data"
    assert found.vetoes
    assert "arm_coulomb (127" in found.words


def test_without_a_predictor_nothing_explains_it() -> None:
    found = judged(18.6, None, random=(NAN, NAN))
    assert found.cause == "unexplained"
    assert "nothing says how much" in found.words
    empty = simulation_residual({}, {}, {}, random=(NAN, NAN), samples_per_radian=20.0, experiments=3)
    assert empty.cause == "noise"  # nobody knows the noise


def test_where_no_noise_is_known_a_poor_simulation_is_judged_and_no_other() -> None:
    def of(error: float, random: tuple[float, float]) -> SimulationResidual:
        channels = {"arm_velocity": error}, {}, {"arm_velocity": 200.0}
        return simulation_residual(*channels, random=random, samples_per_radian=20.0, experiments=3, noise_known=False)

    assert of(60.0, (0.4, 0.0)).cause == "stand-in"
    assert "the simulation is 30 % of the motion away from the recording (arm_velocity)" in of(60.0, (0.4, 0.0)).words
    assert (
        of(60.0, (0.4, 0.0)).headline
        == "Random forces stand in for the physics: the simulation misses 30 % of the motion (arm_velocity)"
    )
    beside = simulation_residual(
        {"arm_velocity": 60.0}, {}, {"arm_velocity": 200.0}, random=(0.4, 0.0), samples_per_radian=20.0, experiments=3,
        noise_known=False, added=("lvdt_gain",),
    )  # fmt: skip
    assert "the simulation with lvdt_gain is 30 % of the motion away" in beside.words
    assert of(60.0, (NAN, NAN)).cause == "unexplained"
    assert of(15.0, (0.4, 0.0)).cause == "noise"  # of a sensor that wanders slowly the fastest changes tell too little
    assert of(15.0, (0.4, 0.0)).words == ""


@pytest.mark.parametrize(
    ("error", "random", "added", "suspect", "cause"),
    [
        (50.0, 1.3, (), "", "stand-in"),  # 2 % of the motion, beside random torques that are the model's own
        (50.0, 0.1, (), "", "shaken"),
        (20.0, 1.3, (), "", "noise"),  # nobody knows whether the sensor wanders as far
        (50.0, 1.3, ("gravity_tilt",), "", "shaken"),  # what was named explains most of what was missing
        (20.0, 0.1, (), "arm_stribeck (98)", "too few data"),
        (9.0, 0.1, (), "arm_stribeck (98)", "noise"),
    ],
)
def test_where_no_noise_is_known_large_random_forces_and_what_is_suspected_are_told_sooner(
    error: float, random: float, added: tuple[str, ...], suspect: str, cause: str
) -> None:
    found = simulation_residual(
        {"arm_angle": error}, {"arm_angle": 1.5 * error}, {"arm_angle": 2000.0}, random=(0.0, random), samples_per_radian=90.0,
        experiments=3, noise_known=False, added=added, suspect=suspect,
    )  # fmt: skip
    assert found.cause == cause


def test_what_nobody_looked_for_is_not_said_to_be_missing_nowhere() -> None:
    """Of estimates that agree beside random forces; only a diagnosis looks for effects."""
    asked = {"random": (0.0, 0.1), "samples_per_radian": 20.0, "experiments": 3}
    told, untold = (
        simulation_residual({"arm_angle": 5.0}, {"arm_angle": 5.0}, {"arm_angle": 200.0}, tested=tested, **asked)
        for tested in (True, False)
    )
    assert (told.cause, untold.cause) == ("shaken", "shaken")
    assert told.words.startswith(
        "One sample ahead nothing is missing. Even so, the simulation is 2.5 % of the motion away"
    )
    assert untold.words.startswith("The simulation is 2.5 % of the motion away")
    assert "stand in for what a diagnosis would find" in untold.words
    assert told.headline.startswith("One sample ahead nothing is missing")
    assert untold.headline.startswith("Random forces, or what they stand in for, explain")


def test_no_sensor_wanders_by_a_tenth_of_the_motion_and_hundreds_of_times_its_fastest_changes() -> None:
    """As where a spring hardens by a tenth of the motion, beside a fine encoder: estimates may agree there by chance."""
    channels = {"cart_position": 445.0}, {"cart_position": 20.0}, {"cart_position": 4612.0}
    found = simulation_residual(
        *channels, random=(0.02, 0.0), samples_per_radian=20.0, experiments=3, noise_known=False
    )
    assert found.cause == "unexplained"
    assert found.vetoes
    assert "the simulation is 9.6 % of the motion away from the recording (cart_position)" in found.words
    assert "known noise" not in found.words
    explained = simulation_residual(
        *channels[:1], {"cart_position": 400.0}, channels[2], random=(0.02, 0.0), samples_per_radian=20.0, experiments=3,
        noise_known=False,
    )  # fmt: skip
    assert explained.cause == "shaken"


@pytest.mark.parametrize(("motion", "cause"), [(2500.0, "unexplained"), (2700.0, "noise")])
def test_what_random_forces_could_not_leave_is_asked_from_a_hundredth_of_the_motion_on(
    motion: float, cause: str
) -> None:
    """Of unknown noise: an encoder of a micrometre tells 7e-5 of the motion of an axis."""
    found = simulation_residual(
        {"arm_angle": 26.0}, {"arm_angle": 300.0}, {"arm_angle": motion}, random=(0.003, 0.007), samples_per_radian=20.0,
        experiments=3, noise_known=False,
    )  # fmt: skip
    assert found.cause == cause


def train(seed: int, duration: float, free: int, forced: int, **hidden: Any) -> Recording:
    rig = virtual_rig.Rig(**hidden)
    plans = virtual_rig.standard_plans(seed=seed, duration=duration, free=free, forced=forced)
    return virtual_rig.record(rig, plans, seed=6).split()[0]


def fitted(recording: Recording) -> est.Fit:
    return est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)


def test_noise_is_known_from_rest_or_from_the_file() -> None:
    recording = train(5, 2.0, 2, 2)
    assert known_noise(recording) == {"cart_position", "arm_velocity"}
    moving = Recording(tuple(e for e in recording if e.kind != "rest"), rig=recording.rig)
    assert known_noise(moving) == frozenset()


@pytest.mark.slow
@OFFERED
@pytest.mark.parametrize("level", [4e-4, 1.5e-4])
def test_dry_friction_in_too_few_data_is_not_called_adequate(
    level: float, offered: tuple[type[Effect], ...] | None
) -> None:
    recording = train(5, 2.0, 2, 2, arm_coulomb=level)
    found = est.diagnose(fitted(recording), recording, candidates=offered, progress=False, thorough=False)
    assert found.verdict == "unknown", found
    assert found.simulation is not None
    assert found.simulation.cause == "too few data"
    assert "nothing is missing at the noise floor" not in found.explanation
    assert "arm_coulomb" in found.explanation
    assert "asks for random forces" not in found.explanation
    assert "Too few data" in found.plot().get_suptitle().replace("\n", " ")


def spoilt(recording: Recording, kind: str) -> Recording:
    side, name, factor = {
        "current of the wrong sign": ("inputs", "current", -1.0),
        "positions in millimetres": ("outputs", "cart_position", 1000.0),
    }[kind]
    found = []
    for e in recording:
        signals = dict(getattr(e, side))
        if name in signals:
            signals[name] = dataclasses.replace(signals[name], values=factor * signals[name].values)
        found.append(dataclasses.replace(e, **{side: signals}))
    return dataclasses.replace(recording, experiments=tuple(found))


@pytest.fixture(scope="module")
def millimetres() -> tuple[est.Fit, Recording]:
    recording = spoilt(train(2, 3.0, 2, 3), "positions in millimetres")
    return fitted(recording), recording


@pytest.mark.slow
@OFFERED
def test_random_forces_in_place_of_the_physics_are_not_called_adequate(
    millimetres: tuple[est.Fit, Recording], offered: tuple[type[Effect], ...] | None
) -> None:
    found = est.diagnose(*millimetres, candidates=offered, progress=False, thorough=False)
    assert found.verdict == "unknown", found
    assert found.simulation is not None
    assert found.simulation.cause == "stand-in"
    assert "stand in for the physics" in found.explanation


@pytest.mark.slow
@OFFERED
def test_nor_where_nobody_knows_the_noise(
    millimetres: tuple[est.Fit, Recording], offered: tuple[type[Effect], ...] | None
) -> None:
    fit, recording = millimetres
    moving = Recording(tuple(e for e in recording if e.kind != "rest"), rig=recording.rig)
    assert known_noise(moving) == frozenset()
    found = est.diagnose(fit, moving, candidates=offered, progress=False, thorough=False)
    assert found.verdict == "unknown", found
    assert found.simulation is not None
    assert found.simulation.cause == "stand-in"
    assert "% of the motion away from the recording" in found.explanation


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_current_of_the_wrong_sign_is_not_called_adequate(seed: int) -> None:
    recording = spoilt(train(seed, 3.0, 2, 3), "current of the wrong sign")
    assert est.diagnose(fitted(recording), recording, progress=False, thorough=False).verdict != "adequate"


@pytest.mark.slow
def test_no_effect_is_named_beside_which_random_forces_stand_in_for_the_physics(
    millimetres: tuple[est.Fit, Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An effect may take a part of what another mistake leaves, and random forces the rest, so that nothing rejects any more."""

    def selected(laboratory: Laboratory, base: FittedModel, findings: Findings, *_: Any) -> tuple[list[Step], Tried]:
        s = next(s for s in findings.scores if s.id == "tacho_gain")
        (extended,) = laboratory.refits(base, [s], "filter").values()
        tests = adequacy_tests(findings, STANDARD.critical)
        return [Step(s.id, (), 100.0, 100.0, 100.0, extended, tests)], {s.id: (base, extended)}

    monkeypatch.setattr(stepwise_selection, "improvements", selected)
    fit, recording = millimetres
    found = est.diagnose(fit, recording, progress=False, thorough=False)
    assert found.verdict == "unknown", found
    assert found.simulation is not None
    assert found.simulation.cause == "stand-in"
    assert found.effects == found.additions == ()
    assert "tacho_gain would improve the predictions" in found.explanation
    assert "not named" in found.explanation
    # Were the random forces modest, no simulation would be asked.
    assert found.evidence is not None
    assert judge(found.evidence, dataclasses.replace(STANDARD, random_large=1.0)).verdict == "missing"


@pytest.fixture(scope="module")
def shaken() -> tuple[est.Fit, Recording]:
    recording = train(3, 3.0, 2, 3, **SHAKEN)
    return fitted(recording), recording


def test_a_shaken_rig_with_nothing_missing_stays_adequate(shaken: tuple[est.Fit, Recording]) -> None:
    fit, recording = shaken
    found = est.diagnose(fit, recording, progress=False, thorough=False)
    assert found.verdict == "adequate", found
    assert found.simulation is not None
    assert found.simulation.cause == "shaken"
    assert "one sample ahead nothing is missing" in found.explanation
    assert "noise floor" not in found.explanation
    # The covariance without corrections foretells how far the simulation strays; the fit absorbs a part of it.
    assert 0.5 < found.simulation.ratio / found.simulation.shaken_ratio < 1.5


def held_together(fit: est.Fit, recording: Recording, *, predicted: bool) -> est.Agreement:
    closed = est.least_squares(rtac.RTAC.from_rig(recording), recording, weak=True)
    more = [est.prediction_error_nonlinear(fit.model, recording, from_model=True, progress=False)] if predicted else []
    return est.agreement([closed, fit, *more], recording, draws=40, progress=False)


def test_estimates_of_a_shaken_rig_agree_but_confirm_no_noise_floor(shaken: tuple[est.Fit, Recording]) -> None:
    found = held_together(*shaken, predicted=True)
    assert found.simulation is not None
    assert found.simulation.cause == "shaken"
    assert not found.rejected, found
    assert found.verdict.startswith("No two disagree")  # what random forces take up may be missing
    assert "rest on holds" not in found.verdict
    assert "nothing is missing" not in found.verdict  # nobody has looked
    assert f"{found.simulation.ratio:.2g} times the known noise" in found.verdict


@pytest.mark.slow
def test_agreement_far_above_the_noise_confirms_nothing(millimetres: tuple[est.Fit, Recording]) -> None:
    found = held_together(*millimetres, predicted=True)
    assert found.simulation is not None
    assert found.simulation.vetoes
    agreeing = dataclasses.replace(
        found,
        pairs=tuple(
            dataclasses.replace(pair, p_value=0.4, p_values=np.ones_like(pair.p_values)) for pair in found.pairs
        ),
    )
    for one in (found, agreeing):
        assert "They agree" not in one.verdict
        assert "rest on holds" not in one.verdict
    assert agreeing.verdict.startswith("No two disagree")
    assert "confirms nothing" in agreeing.plot().get_suptitle().replace("\n", " ")
