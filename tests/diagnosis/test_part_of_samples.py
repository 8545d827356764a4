"""Of a long recording whose fit is far from the noise a part is looked at, if that tells what is missing."""

import dataclasses
import importlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from known_search import Known, known, screened
from made_up_results import FIT, candidate, diagnosis

import estimators as est
import rtac_jax as rtac
from estimators.core.data import moving, pieces
from estimators.diagnosis import part_of_samples
from estimators.diagnosis.choice import chosen
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.part_of_samples import Looked, enough_of, is_told_by_more, left_beyond_chance
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.removed_error import removed_beside
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import AdequacyTest
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE

diagnose = importlib.import_module("estimators.diagnosis.diagnose")  # a function of that name hides it
NOISE = 1e-6


def locked(count: int, samples: int, *, from_sample: int = 0) -> rtac.Recording:
    """Carts that swing by 10 mm, after some samples in which they hardly do."""
    number = np.arange(samples)
    position = np.where(number < from_sample, 1e-4, 1e-2) * np.cos(0.05 * number)
    several = [
        rtac.Experiment.of(f"run_{n}", kind="free", sample_time=0.005, arm="locked", cart_position=position + 1e-6 * n)
        for n in range(count)
    ]
    return rtac.Recording(several, {"total_mass": 1.5})


def left_of(recording: rtac.Recording, fraction: float) -> est.Fit:
    """A fit that leaves so much of the motion."""
    rms = float(np.mean([np.std(e.outputs["cart_position"].values) for e in recording]))
    return dataclasses.replace(FIT, residual_std={"cart_position": fraction * rms}, noise={"cart_position": NOISE})


@pytest.mark.parametrize(
    ("recording", "left", "looked_at"),
    [
        (locked(5, 8000), 0.9, 16_000),
        (locked(2, 20_000), 0.9, 16_000),  # in pieces
        (locked(20, 2000), 0.9, 20_000),  # a thousand of each at least
        (locked(5, 8000), 0.1, 16_000),  # it follows, a thousand times the noise away
        (locked(5, 8000), 1e-4, None),  # at the noise
        (locked(3, 8000), 0.9, None),  # few anyway
        (locked(5, 8000, from_sample=7000), 0.9, None),  # the beginnings show nothing
    ],
)
def test_a_part_is_looked_at_where_the_fit_misses_more_than_the_sensors_do(
    recording: rtac.Recording, left: float, looked_at: int | None
) -> None:
    part = enough_of(left_of(recording, left), recording, STANDARD)
    if looked_at is None:
        assert part is recording
        return
    assert sum(e.samples for e in part) == pytest.approx(looked_at, rel=0.05)
    each = dataclasses.replace(FIT.model, per_experiment=frozenset({"cart_coulomb.level"}))
    assert enough_of(dataclasses.replace(left_of(recording, left), model=each), recording, STANDARD) is recording
    known = {e.name for e in pieces(moving(recording))}
    assert {e.name for e in pieces(moving(part))} <= known  # their starts are those of the fit


def test_a_part_of_many_experiments_has_no_part() -> None:
    part = part_of_samples.part_of(locked(40, 2000))
    assert sum(e.samples for e in part) == 40_000
    assert part_of_samples.part_of(part) is part


def told(verdict: Any, *, rival: bool = False) -> est.Diagnosis:
    """A diagnosis that names a cubic spring, if it names anything."""
    if verdict in ("adequate", "unknown"):
        return diagnosis(verdict)
    named = candidate("cubic_spring", 50.0, confusable_with=("quadratic_spring",) if rival else ())
    return dataclasses.replace(diagnosis(verdict), effects=(named,), additions=(CATALOGUE["cubic_spring"](1.0),))


HALF = Step("cubic_spring", (), 11_090.0, 0.0, 0.0, FittedModel(1, ("cubic_spring",), 1, 0.0), ())
"""What takes half of the squares off 16,000 samples."""


def looked(found: est.Diagnosis, monkeypatch: pytest.MonkeyPatch, *, left: float, by_more: bool, excess: float) -> Any:
    """What came of a part: the mean square that it leaves of all samples, and what its tests find beyond chance."""
    monkeypatch.setattr(part_of_samples, "left_of_all", lambda *_: left)
    monkeypatch.setattr(Looked, "told_by_more", lambda self, times: by_more)
    tests = (AdequacyTest("named effects", 1e-9 if excess else 1.0, excess, 0.01, ""),)
    steps = (HALF,) if found.additions else ()
    judged = SimpleNamespace(steps=steps, left=tests, final=None, selection=SimpleNamespace(simulated=False))
    laboratory = SimpleNamespace(
        policy=STANDARD,
        facts=SimpleNamespace(samples=16_000),
        models=SimpleNamespace(computed=lambda _: (None, None)),
    )
    return Looked(found, laboratory, judged)  # type: ignore[arg-type] - made up


@pytest.mark.parametrize(
    ("missed", "found", "left", "by_more", "excess", "whole_too"),
    [
        (0.9, told("ambiguous", rival=True), 9.0, True, 0.0, False),  # nothing is followed: anything brings it nearer
        (0.9, told("unknown"), 1.3, False, 400.0, True),  # nine times what is found in the part, and more
        (0.1, told("missing"), 1.12, False, 0.0, False),
        (0.1, told("missing"), 1.13, False, 0.0, True),  # a tenth of what is missing is left
        (0.1, told("missing"), np.inf, False, 0.0, True),
        (0.1, told("ambiguous", rival=True), 1.0, True, 0.0, True),
        (0.1, told("ambiguous", rival=True), 1.0, False, 0.0, False),  # as an offset of a force and one of a sensor
        (0.1, told("adequate"), 1.0, False, 0.0, True),
        (0.1, told("unknown"), 1.18, False, 330.0, False),  # what only the rest shows would not be named
        (0.1, told("unknown"), 1.01, False, 310.0, True),  # what is small more samples may tell
        (0.1, told("unknown"), 1.19, False, 330.0, True),
        (0.1, dataclasses.replace(told("unknown"), broken_off=("lvdt_gain",)), 1.0, False, 330.0, True),
    ],
)
def test_all_samples_are_looked_at_where_a_part_does_not_tell(
    missed: float,
    found: est.Diagnosis,
    left: float,
    by_more: bool,
    excess: float,
    whole_too: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = locked(5, 8000)
    looked_at: list[int] = []

    def diagnosed(fit: est.Fit, recording: rtac.Recording, *_: Any, **known: Any) -> Any:
        looked_at.append(sum(e.samples for e in recording))
        assert known["thorough"]
        return looked(found, monkeypatch, left=left, by_more=by_more, excess=excess)

    monkeypatch.setattr(diagnose, "_diagnosed", diagnosed)
    names = tuple(e.name for e in whole)
    fit = dataclasses.replace(left_of(whole, missed), experiments=names, model=rtac.RTAC.from_rig(whole))
    said = est.diagnose(fit, whole, progress=False).explanation
    assert looked_at == ([16_000, 40_000] if whole_too else [16_000])
    assert ("16,000 samples of all experiments were looked at" in said) == (not whole_too)
    assert ("follows nothing" in said) == (missed == 0.9 and not whole_too)
    assert ("misses more than the sensors do" in said) == (missed == 0.1 and not whole_too)
    assert ("the model with what is named" in said) == (bool(found.additions) and not whole_too)
    assert ("the others show nothing that could be named" in said) == (not found.additions and not whole_too)


@pytest.mark.parametrize(
    ("lag", "times", "by_more"), [(999.0, 4.0, False), (999.0, 6.0, True), (996.0, 1.2, False), (996.0, 1.5, True)]
)
def test_more_samples_tell_what_their_likelihoods_would(lag: float, times: float, by_more: bool) -> None:
    """In proportion: 2 and 8 in twice the log-likelihood of a part, where 10 are told."""
    search = Known(known(base=0.0, cubic_spring=1000.0, lvdt_lag=lag))
    step = chosen(
        search, search.base, {i: (screened(i), search.model(i)) for i in ("cubic_spring", "lvdt_lag")}, STANDARD
    )
    assert step is not None
    assert step.rivals == ("lvdt_lag",)
    refits = {(search.base.number, i): search.model(i) for i in ("cubic_spring", "lvdt_lag")}
    asked: Any = {"samples": 10_000, "times": times}
    assert is_told_by_more(search.base, [step], refits, STANDARD, **asked) == by_more
    second = dataclasses.replace(step, rivals=())
    later = {(step.model.number, "lvdt_lag"): search.model("lvdt_lag")}
    assert is_told_by_more(search.base, [second, step], later, STANDARD, **asked) == by_more
    assert is_told_by_more(
        search.base, [second, step], refits, STANDARD, **asked
    )  # it was fitted beside another model only


@pytest.fixture(scope="module")
def decays() -> rtac.Recording:
    """Decays of an independent rig with a hardening spring whose arm is locked."""
    rig = dataclasses.replace(virtual_rig.Rig(), cubic_spring=2e4)
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.002, duration=14.0, free=5, forced=0, rest=1)
    return virtual_rig.record(rig, plans, seed=4)


def diagnosed(recording: rtac.Recording) -> est.Diagnosis:
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    few = [CATALOGUE[n] for n in ("cubic_spring", "quadratic_spring", "cart_quadratic_drag", "lvdt_nonlinearity")]
    return est.diagnose(fit, recording, candidates=few, progress=False)


@pytest.mark.slow
def test_a_part_names_what_is_hidden_with_its_size(decays: rtac.Recording) -> None:
    assert sum(e.samples for e in moving(decays)) > 32_000
    found = diagnosed(decays)
    assert (found.verdict, [c.id for c in found.effects]) == ("missing", ["cubic_spring"]), found
    assert "16,000 samples of all experiments were looked at" in found.explanation
    estimate = found.effects[0].parameters["stiffness"]
    assert abs(estimate.value - 2e4) < 3 * estimate.std < 0.1 * 2e4
    assert found.evidence is not None
    assert found.evidence.facts.samples < 32_000


def test_where_the_time_is_over_the_part_is_all_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = locked(5, 8000)

    def diagnosed(*_: Any, **__: Any) -> Any:
        return looked(told("adequate"), monkeypatch, left=1.0, by_more=False, excess=0.0)

    monkeypatch.setattr(diagnose, "_diagnosed", diagnosed)
    fit = dataclasses.replace(
        left_of(whole, 0.1), experiments=tuple(e.name for e in whole), model=rtac.RTAC.from_rig(whole)
    )
    said = est.diagnose(fit, whole, within=0.0, progress=False).explanation
    assert "The time was over when 16,000 samples of all experiments had been looked at" in said
    assert "were looked at" not in said


@pytest.mark.parametrize(
    ("gain", "left", "removed"), [(0.0, 0.9, 0.0), (-5.0, 1.0, 0.0), (70.0, 0.99, 1.0), (70.0, 2.0, 0.668)]
)
def test_what_is_removed_beside_what_is_left(gain: float, left: float, removed: float) -> None:
    """Of 100 samples; a gain of 70 leaves half of the squares."""
    step = Step("cubic_spring", (), gain, gain, gain, FittedModel(1, ("cubic_spring",), 1, 0.0), ())
    assert removed_beside([step], 100, left) == pytest.approx(removed, abs=2e-3)


def test_what_is_left_counts_neither_chance_nor_what_is_shaken() -> None:
    random = np.random.default_rng(8)
    innovations = random.normal(size=(5000, 2, 3))
    counted, shaken = np.ones_like(innovations), np.zeros((5000, 3))
    counted[:, 1, 2] = 0.0
    innovations[:, 1, 2] = 100.0  # was not measured
    shaken[:50] = 1.0
    innovations[:50] = 100.0
    left = left_beyond_chance(innovations, counted, shaken, samples=8000)
    mean = float(np.mean(np.concatenate([innovations[50:, 0].ravel(), innovations[50:, 1, :2].ravel()]) ** 2))
    assert left == pytest.approx(mean - np.sqrt(2 / 8000 + 2 / (5 * 4950)), abs=1e-12)
    assert mean == pytest.approx(1.0, abs=0.03)


def test_chance_leaves_something_in_one_of_six() -> None:
    """Noise whose size is known from 4,000 samples, and innovations of 20,000: beyond one deviation in 16 % of all draws."""
    random = np.random.default_rng(9)
    counted, shaken = np.ones((20_000, 1, 1)), np.zeros((20_000, 1))
    left = []
    for _ in range(400):
        size = np.sqrt(np.mean(random.normal(size=4000) ** 2))
        left.append(left_beyond_chance(random.normal(size=(20_000, 1, 1)) / size, counted, shaken, samples=4000))
    assert 0.10 < np.mean(np.array(left) > 1.0) < 0.22  # three deviations of 400 draws to either side


def test_what_simulations_named_is_asked_of_all_samples() -> None:
    """Their steps gain in squares of a simulation, which say nothing of predictions."""
    whole = locked(5, 8000)
    by_simulation: Any = Looked(None, None, SimpleNamespace(selection=SimpleNamespace(simulated=True)))  # type: ignore[arg-type] - made up
    assert by_simulation.left_of_all(left_of(whole, 0.1), whole) == np.inf


@pytest.mark.slow
def test_what_only_the_rest_shows_asks_for_all_samples(decays: rtac.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody pulls the cart again, a tenth as far, after 8 s of each decay: the part ends at 6.4 s."""
    late, really = 4000, diagnose._diagnosed
    looked_at: list[float] = []

    class _SecondLookError(Exception):
        pass

    def once(fit: est.Fit, recording: rtac.Recording, *others: Any, **known: Any) -> Any:
        looked_at.append(max(e.samples for e in moving(recording)))
        if len(looked_at) > 1:
            raise _SecondLookError
        return really(fit, recording, *others, **known)

    def changed(e: rtac.Experiment) -> rtac.Experiment:
        if e.kind == "rest":
            return e
        signal = e.outputs["cart_position"]
        read = np.concatenate([signal.values[:late], 0.1 * signal.values[: e.samples - late]])
        return dataclasses.replace(e, outputs={**e.outputs, "cart_position": dataclasses.replace(signal, values=read)})

    monkeypatch.setattr(diagnose, "_diagnosed", once)
    with pytest.raises(_SecondLookError):
        diagnosed(dataclasses.replace(decays, experiments=tuple(changed(e) for e in decays.experiments)))
    assert looked_at == [3200, 7000]
