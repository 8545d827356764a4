"""A measured current with noise: it shakes the model, which then needs nothing else, and whose simulation ends beside the truth."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.evidence import EffectTraits, Evidence, Facts, FittedModel, SimulationError
from estimators.diagnosis.explanation import shaken
from estimators.misspecification.findings import Findings, Score
from rtac_jax import virtual_rig
from rtac_jax.measurement import Recording

TRUTH = {"torque_constant": 0.07, "spring_stiffness": 260.0}
NOISE = 5e-3  # A


def with_noise(recording: Recording) -> Recording:
    """Return a recording whose currents are measured with noise; the rig felt them without it."""
    generator, found = np.random.default_rng(4), []
    played = {e.name: e.inputs["current"] for e in recording if "current" in e.inputs}
    one = next(iter(played.values()))
    for e in recording:
        felt = played[e.name].values if e.name in played else np.zeros(e.samples)
        measured = dataclasses.replace(one, values=felt + NOISE * generator.standard_normal(e.samples))
        found.append(dataclasses.replace(e, inputs={**e.inputs, "current": measured}))
    return dataclasses.replace(recording, experiments=tuple(found))


@pytest.fixture(scope="module")
def recording() -> Recording:
    rig = virtual_rig.Rig(
        **TRUTH, total_mass=1.8, arm_inertia=1.5e-4, eccentric_moment=2.2e-3, cart_viscous=0.8, cart_coulomb=0.03,
        arm_viscous_positive=2e-4, arm_viscous_negative=1.8e-4, encoder=True,
    )  # fmt: skip
    plans = virtual_rig.standard_plans(seed=31, sample_time=0.004, duration=6.0, free=2, forced=3, rest=1)
    return with_noise(virtual_rig.record(rig, plans, seed=32))


def test_the_noise_of_a_current_is_read_off_where_nothing_drives(recording: Recording) -> None:
    assert recording.current_noise() == pytest.approx(NOISE, rel=0.05)
    driven = [e.name for e in recording if e.kind == "forced"]
    assert recording.select(driven).current_noise() == 0.0, "nothing tells it from what drives"


@pytest.mark.slow
def test_it_explains_what_leads_the_simulation_astray_and_predictions_are_what_is_kept(recording: Recording) -> None:
    several = [rtac.effects.CATALOGUE[name] for name in ("arm_coulomb", "arm_stribeck")]
    found = est.improve(rtac.RTAC.from_rig(recording), recording, candidates=several, progress=False)
    assert found.verdict == "adequate", found
    told = found.diagnoses[-1]
    assert told.simulation is not None
    assert told.simulation.cause == "shaken"
    assert "the measured current has noise that shakes the model as much, so nothing else need be" in told.explanation
    assert found.by_predictions is not None
    assert told.random_torque == pytest.approx(told.evidence.facts.current_noise, rel=0.15)
    for name, truth in TRUTH.items():
        estimate = found.by_predictions.parameters[name]
        assert abs(estimate.value - truth) < 4 * estimate.std, name
    stiffness = found.final.parameters["spring_stiffness"]
    assert abs(stiffness.value - TRUTH["spring_stiffness"]) > 4 * stiffness.std, (
        "a simulation knows no noise of the current"
    )
    assert found.diagnoses[-1].simulation is not None
    assert found.diagnoses[-1].simulation.cause == "shaken"
    stated = dataclasses.replace(recording, rig={"total_mass": 1.8}, rig_std={"total_mass": 0.01})
    weighed = rtac.RTAC.from_rig(stated).with_values({"total_mass": 1.5})
    moved = dataclasses.replace(found.final, model=weighed, result=est.RESULTS.successful)
    assert len(moved.moved_constants) == 1
    constant = dataclasses.replace(found, fits=(*found.fits[:-1], moved))
    assert "stated standard deviations" not in constant.ending, "no constant is held against what goes astray"
    calm = dataclasses.replace(constant, diagnoses=(*found.diagnoses[:-1], dataclasses.replace(told, simulation=None)))
    assert "stated standard deviations" in calm.ending


@pytest.mark.parametrize(
    ("noise", "random", "cause"),
    [
        (0.0, (0.0, 0.03), "too few data"),
        (0.03, (0.0, 0.03), "shaken"),
        (0.03, (0.0, 0.04), "shaken"),
        (0.03, (0.0, 0.05), "too few data"),
        (0.03, (0.02, 0.03), "too few data"),
    ],
    ids=["a command", "all of it", "most of it", "less than half of it", "and a force on the cart"],
)
def test_an_effect_is_not_suspected_where_the_noise_explains_the_error(
    noise: float, random: tuple[float, float], cause: str
) -> None:
    """One that the data are too few to confirm."""
    base = FittedModel(0, (), 5, 0.0, random_force=random[0], random_torque=random[1])
    score = Score("arm_stribeck", 0, ("peak",), 21.0, 1.0, (1.0,))
    facts = Facts(
        samples=9000, seconds=5, experiments=3, rest=True, noise_known=True, samples_per_radian=20.0,
        noise={"arm_angle": 1e-3}, effects={"arm_stribeck": EffectTraits()}, current_noise=noise,
    )  # fmt: skip
    error = SimulationError({"arm_angle": 9.0}, {"arm_angle": 9.0}, {"arm_angle": 900.0}, random)
    evidence = Evidence(
        facts=facts, thorough=False, models=(base,), coloured=None, colour_asked=True, refits=(),
        findings={0: Findings(scores=(score,))}, quiet={}, held_out={}, simulations={0: error}, policy={},
    )  # fmt: skip
    found = est.judge(evidence).simulation
    assert found is not None
    assert found.cause == cause
    assert ("the measured current has noise" in found.words) == (cause == "shaken")


def test_the_random_torque_is_told_for_what_it_is() -> None:
    assert "nothing need shake the rig" in shaken(0.0, 0.03, 0.0, of_the_current=True)
    assert "the rig is shaken" in shaken(0.0, 0.03, 0.0)
