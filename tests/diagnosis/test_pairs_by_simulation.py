"""Two effects of which neither explains most by itself, found by simulation where a large candidate scatters over the seconds."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from known_search import Known, known, sized
from scipy.integrate import solve_ivp

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.evidence import FittedModel, HeldOut, SimulationError
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.verdict import decide
from estimators.misspecification.findings import Findings, Score

# Of a pendulum with gravity in its model, and dry friction and drag missing: errors of simulations over the noise.
ERRORS = known(
    base=18.6, arm_coulomb=18.6, arm_stribeck=17.5, arm_quadratic_drag=14.2,
    arm_quadratic_drag__arm_coulomb=5.0, arm_quadratic_drag__arm_stribeck=1.4,
)  # fmt: skip
LIKELIHOODS = known(base=0.0, arm_stribeck=68.0, arm_quadratic_drag=3.0, arm_quadratic_drag__arm_coulomb=350.0)


class Pendulum(Known):
    """A laboratory in which Stribeck friction is large, and scatters; an effect gains the same in all of three experiments."""

    def __init__(self, ended: float, gained: float = 20.0, statistic: float = 98.0, likelier: float = 68.0) -> None:
        super().__init__(
            LIKELIHOODS | known(arm_stribeck=likelier), held_out=dict.fromkeys(("arm_stribeck", "arm_coulomb"), gained)
        )
        self.ended, self.statistic, self.begun = ended, statistic, False
        self.facts = self.facts.__class__(**{**vars(self.facts), "experiments": 3, "seconds": 6})

    def model(self, *effects: str) -> FittedModel:
        return FittedModel(**{**vars(super().model(*effects)), "random_torque": 0.065})

    def findings(self, model: FittedModel) -> Findings:
        return Findings() if model.added else Findings((sized("arm_stribeck", self.statistic, 0.5),))

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        several = (("arm_stribeck", 98.0), ("arm_coulomb", 15.0), ("arm_quadratic_drag", 25.0))
        return tuple(sized(effect, size, 1e-3) for effect, size in several if effect not in model.added)

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        one = super().held_out(before, after)
        return HeldOut((0.5 * one.gain[0], 0.5 * one.gain[0], -1.0), (1.0, 1.0, 1.0))

    def simulation(self, model: FittedModel) -> SimulationError:
        error = self.ended if len(model.added) == 2 else ERRORS[frozenset(model.added)]
        return SimulationError({"arm_angle": error}, {"arm_angle": 40.0}, {"arm_angle": 1900.0}, (0.0, 0.065))

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        self.begun = True
        known = {s.id: ERRORS.get(frozenset({*before.added, s.id})) for s in several}
        return {effect: {"arm_angle": error} for effect, error in known.items() if error is not None}


def test_a_pair_is_named_of_which_neither_explains_most_by_itself() -> None:
    """Few steps leave the pair at five times the noise; what counts is where it ends, and that friction presupposes the simpler."""
    found = decide(Pendulum(ended=1.1), STANDARD, thorough=True)
    assert (found.verdict, found.effects) == ("missing", ("arm_quadratic_drag", "arm_coulomb"))
    assert found.removed == pytest.approx(1 - (1.1**2 - 1) / (18.6**2 - 1))


def test_no_pair_is_named_where_a_policy_allows_one_effect() -> None:
    found = decide(Pendulum(ended=1.1), dataclasses.replace(STANDARD, effects=1), thorough=True)
    assert found.effects == ()


def test_a_large_candidate_that_a_refit_supports_and_nothing_confirms_leaves_no_adequate_model() -> None:
    found = decide(Pendulum(ended=9.0), STANDARD, thorough=True)
    assert (found.verdict, found.effects) == ("unknown", ())
    assert found.simulation is not None
    assert found.simulation.cause == "too few data"
    assert "arm_stribeck (98, the alarm is at 20)" in found.simulation.words


@pytest.mark.parametrize(
    ("gained", "statistic", "likelier", "asked"),
    [(2.0, 98.0, 68.0, True), (20.0, 15.0, 68.0, False), (20.0, 98.0, 9.0, True)],
)
def test_what_does_not_speak_leaves_it_adequate(gained: float, statistic: float, likelier: float, asked: bool) -> None:
    """A refit that predicts nothing of what it has not seen, or gains little; and a candidate below the alarm asks nothing."""
    laboratory = Pendulum(ended=9.0, gained=gained, statistic=statistic, likelier=likelier)
    assert decide(laboratory, STANDARD, thorough=True).verdict == "adequate"
    assert laboratory.begun is asked


INERTIA, GRAVITY, VISCOUS, DRY, DRAG = 1.0, 121.0, 0.6, 3.0, 0.05  # kg m^2, N m, N m s/rad, N m, N m s^2/rad^2
TURN = 2 * np.pi / 4000


def swing(name: str, begin: float, random: np.random.Generator) -> rtac.Experiment:
    """Two seconds of a pendulum by an encoder of 4,000 counts; its friction is nearly discontinuous."""
    time = 0.002 * np.arange(1001)

    def rate(_: float, at: np.ndarray) -> list[float]:
        friction = VISCOUS * at[1] + DRY * np.tanh(at[1] / 5e-4) + DRAG * abs(at[1]) * at[1]
        return [at[1], -(GRAVITY * np.sin(at[0]) + friction) / INERTIA]

    options = {"t_eval": time, "method": "LSODA", "rtol": 1e-9, "atol": 1e-10, "max_step": 0.002}
    angle = solve_ivp(rate, (0, 2.0), [np.deg2rad(begin), 0.0], **options).y[0]
    read = TURN * np.round((angle + 1e-4 * random.standard_normal(len(time))) / TURN)
    return rtac.Experiment.of(name, kind="free", sample_time=0.002, cart="clamped", arm_angle=read)


@pytest.mark.slow
def test_dry_friction_and_drag_of_a_pendulum_are_found_beside_gravity() -> None:
    """Four swings of two seconds, of which one is held out: gravity alone was adequate at 19 and 48 times the noise."""
    random = np.random.default_rng(810)
    several = [swing(f"swing_{n}", begin, random) for n, begin in enumerate((-150.0, -105.0, -75.0, -45.0))]
    recording = rtac.Recording(several, rig={"arm_inertia": INERTIA})
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert {c.id for c in found.added} == {"gravity_tilt", "arm_quadratic_drag", "arm_coulomb"}, found
    values = found.final.parameters
    for name, truth in (("arm_coulomb.level", DRY), ("arm_quadratic_drag.coefficient", DRAG)):
        assert values[name].value == pytest.approx(truth, abs=4 * values[name].std)
        assert values[name].std < 0.01 * truth
    assert values["arm_viscous.positive"].value == pytest.approx(VISCOUS, rel=0.01)
    assert max(e.rms_over_noise for e in found.validation.models[-1].errors.values()) < 1.3
