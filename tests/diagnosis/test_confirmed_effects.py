"""What acts at a few instants scatters over the seconds of data, and experiment after experiment confirms it.

A drive whose friction is that of bristles and rises near rest, simulated by code of its own: steps of 20 us, bristles in closed
form.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from known_search import Known, force, known, sized

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.evidence import FittedModel, HeldOut
from estimators.diagnosis.explanation import unconfirmed
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import select
from estimators.misspecification.findings import Findings
from rtac_jax.effects import CATALOGUE, ArmCoulomb, ArmStribeck, Effect

INERTIA, TORQUE_CONSTANT, VISCOUS = 2e-5, 0.05, 1.5e-5  # kg m^2, N m/A, N m s
COULOMB, NEAR_REST, SPEED, STIFFNESS = (
    4e-3,
    2.4e-3,
    5.0,
    10.0,
)  # N m, N m more near rest, rad/s, N m/rad of the bristles
COUNT, SAMPLE_TIME, STEPS = 2 * math.pi / 2000, 2e-3, 100


def drive(name: str, size: float, frequency: float, seconds: float, seed: int) -> rtac.Experiment:
    """A run under a multisine and a square wave of this size [A] and frequency [Hz]."""
    random = np.random.default_rng(seed)
    time = SAMPLE_TIME * np.arange(round(seconds / SAMPLE_TIME))
    lines = np.arange(1, round(8 * seconds))
    waves = np.sin(2 * np.pi * np.outer(time, lines) / seconds + random.uniform(0, 2 * np.pi, len(lines))).sum(1)
    square = np.sign(np.sin(2 * np.pi * frequency * time + 0.3))
    current = 0.6 * size * waves / np.max(np.abs(waves)) + 0.7 * size * square
    step = SAMPLE_TIME / STEPS
    angle = speed = bristle = 0.0
    angles = []
    for now in current.tolist():
        angles.append(COUNT * round(angle / COUNT))
        for _ in range(STEPS):
            level = COULOMB + NEAR_REST * math.exp(-((speed / SPEED) ** 2))
            end = math.copysign(level / STIFFNESS, speed)
            bristle = end + (bristle - end) * math.exp(-abs(speed) * step * STIFFNESS / level)
            speed += step * (TORQUE_CONSTANT * now - VISCOUS * speed - STIFFNESS * bristle) / INERTIA
            angle += step * speed
    return rtac.Experiment.of(
        name, kind="forced", sample_time=SAMPLE_TIME, cart="clamped", initial_arm_angle=0.0, arm_angle=np.array(angles),
        current=current + 2e-4 * random.standard_normal(len(time)),
    )  # fmt: skip


# In every run of the tests it is offered beside two others; with the whole catalogue compiling takes four times as long.
FEW = tuple(CATALOGUE[name] for name in ("arm_stribeck", "cogging", "current_offset"))


@pytest.mark.slow
@pytest.mark.parametrize("offered", [FEW, None], ids=["few", "whole"])
def test_friction_that_rises_near_rest_is_named_though_it_scatters(offered: tuple[type[Effect], ...] | None) -> None:
    runs = [(0.25, 0.8, 2.5), (0.3, 1.1, 2.2), (0.35, 1.4, 2.6)]
    recording = rtac.Recording(
        [drive(f"run {n}", *run, seed=31 + n) for n, run in enumerate(runs)],
        rig={"arm_inertia": INERTIA, "eccentric_moment": 1e-6}, rig_std={"arm_inertia": 0.01 * INERTIA},
    )  # fmt: skip
    fit = est.output_error(rtac.RTAC.from_rig(recording) + ArmCoulomb(COULOMB), recording, progress=False)
    found = est.diagnose(fit, recording, candidates=offered, progress=False)
    (by_name,) = [test for test in found.tests if test.test == "named effects"]
    assert not by_name.rejects
    assert "arm_stribeck reaches" in by_name.words
    assert (found.verdict, [c.id for c in found.effects]) == ("missing", [ArmStribeck.id])
    assert "3 of 3 experiments confirm it, and none speaks against it" in found.explanation
    assert found.evidence is not None
    again = est.judge(found.evidence)
    assert (again.effects, again.incomplete) == ((ArmStribeck.id,), ())


class Runs(Known):
    """Experiments each of which gains so much by an effect that is estimated from the others."""

    def __init__(self, *gains: float, shown: float | Sequence[float] = 1.0) -> None:
        super().__init__(known(base=0.0, arm_stribeck=200.0))
        self.by_run = gains
        self.shown = [shown] * len(gains) if isinstance(shown, float) else shown
        scores = (sized("arm_stribeck", 300.0, 1e-3), sized("lvdt_lag", STANDARD.alarm - 1, 1e-3))
        self.rejects = lambda model: Findings() if model.added else Findings(scores=scores)

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        return HeldOut(self.by_run, tuple(self.shown))


ENOUGH = STANDARD.bic_gain / 2  # of the log-likelihood: very strong evidence


@pytest.mark.parametrize(
    ("runs", "named"),
    [
        (Runs(2 * ENOUGH, 2 * ENOUGH, 1.1 * ENOUGH), ["arm_stribeck"]),
        (Runs(20 * ENOUGH, 20 * ENOUGH, 0.9 * ENOUGH), []),
        (Runs(20 * ENOUGH, 20 * ENOUGH, math.nan), []),
        (Runs(*3 * (2 * ENOUGH,), -0.9 * ENOUGH), ["arm_stribeck"]),
        (Runs(*3 * (2 * ENOUGH,), -1.1 * ENOUGH, shown=(1.0, 1.0, 1.0, 0.0)), []),
        (Runs(20 * ENOUGH, 20 * ENOUGH), []),
        (Runs(*3 * (2 * ENOUGH,), shown=0.5 * STANDARD.known), []),
    ],
    ids=[
        "each confirms it",
        "one does not",
        "one cannot be told",
        "one shows nothing of it",
        "one speaks against it",
        "two are too few",
        "others know nothing of it",
    ],
)
def test_three_experiments_must_confirm_it_and_none_speak_against_it(runs: Runs, named: list[str]) -> None:
    found = select(runs, STANDARD, thorough=True)
    assert [step.id for step in found.steps] == named
    assert "arm_stribeck" in found.tried
    assert "lvdt_lag" not in found.tried, "it is not as large as the alarm"
    assert select(runs, STANDARD, thorough=False).steps == []


def test_pieces_of_one_experiment_are_one() -> None:
    runs = Runs(*4 * (2 * ENOUGH,))
    runs.facts = dataclasses.replace(runs.facts, origins=("long", "long", "long", "short"))
    assert select(runs, STANDARD, thorough=True).steps == []
    runs.facts = dataclasses.replace(runs.facts, origins=("long", "long", "short", "other"))
    assert select(runs, STANDARD, thorough=True).confirmed == (3, 3)


def test_what_a_test_rejects_all_the_same_is_not_confirmed() -> None:
    """Nothing rejected before, and with the effect something does: the model stays adequate, and is not unknown for it."""
    runs = Runs(*3 * (2 * ENOUGH,))
    before = runs.rejects
    runs.rejects = lambda model: Findings(curves=(force(2000.0),)) if model.added else before(model)
    found = select(runs, STANDARD, thorough=True)
    assert found.steps == []
    assert found.named(runs.facts.samples, STANDARD)[0] == "adequate"


def candidate(name: str, chi_square: float, p_value: float) -> Candidate:
    return Candidate(name, chi_square - 9, chi_square, p_value, 1.0, "N m", testable=True)


def test_an_adequate_verdict_names_what_is_large_and_was_not_confirmed() -> None:
    several = [
        candidate("arm_stribeck", 300.0, 0.02),
        candidate("cubic_spring", 500.0, 1e-9),
        candidate("backlash", 8.0, 1.0),
    ]
    said = unconfirmed(several, (), STANDARD, thorough=True)
    assert "arm_stribeck reaches 300, the alarm is at 20" in said
    assert "the experiments do not confirm it" in said
    assert "a thorough diagnosis asks" in unconfirmed(several, (), STANDARD, thorough=False)
    assert unconfirmed(several[1:], (), STANDARD, thorough=True) == ""
    assert unconfirmed(several, several[1:2], STANDARD, thorough=True) == ""
