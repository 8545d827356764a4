"""Fits of a chunk side by side: the same bits in any company, and what a single fit says."""

import dataclasses

import numpy as np
import pytest
from small_study import DECAYS, FREE, batched, same_bits, small

import estimators as est
from estimators.core.sensor_noise import noise_levels
from estimators.study import Estimate, Fitted, Plant, fit_chunk, run
from estimators.study.batched_fits import fit_together, suits
from estimators.study.chunk_size import per_chunk
from estimators.study.fit_chunk import model_for
from estimators.study.outcome import Outcome, Prepared, Value
from estimators.study.recordings import recordings
from estimators.study.truth import true_for

QUIET = {"progress": False}
SPEC = batched()


def prepared(count: int, **rig: float) -> list[Prepared]:
    spec = dataclasses.replace(SPEC, excitation=(DECAYS,), plant=Plant(spread=0.1, values=rig))
    truths = [true_for(spec, index) for index in range(count)]
    data = recordings(spec, range(count), truths)
    return [Prepared(model_for(spec, t, r), r, t) for t, r in zip(truths, data, strict=True) if not isinstance(r, str)]


@pytest.fixture(scope="module")
def whole():
    return est.study(SPEC, chunk=8, **QUIET)


@pytest.mark.parametrize("chunk", [1, 3, 7])
def test_the_bits_do_not_depend_on_the_chunk(whole, chunk):
    """Cut into chunks of other sizes, a repetition has other company, and another place among it."""
    assert set(whole["verdict"].values[:, 0]) == {"successful"}
    assert same_bits(est.study(SPEC, chunk=chunk, **QUIET), whole)


@pytest.mark.slow
def test_the_bits_do_not_depend_on_the_process(whole):
    """A spawned process beside this one; on two, dask's test has it."""
    with run._Pool(1) as pool:  # starting it is what takes the time
        assert same_bits(est.study(SPEC, executor=pool, chunk=3, **QUIET), whole)


def test_the_bits_do_not_depend_on_what_else_is_in_the_study(whole):
    longer = est.study(dataclasses.replace(SPEC, repetitions=11), chunk=11, **QUIET)
    for name in ("estimate", "std", "quantities"):
        np.testing.assert_array_equal(longer[name].values[:8], whole[name].values)


def test_more_than_there_are_places_for_have_the_same_bits():
    """Places are taken again as fits end, so that company and places are others than in a chunk of one."""
    several = prepared(70)
    together = fit_together(several, {})
    for number in (0, 37, 69):
        assert fit_together(several[number : number + 1], {}) == [together[number]]
    order = np.random.default_rng(1).permutation(70)
    assert fit_together([several[n] for n in order], {}) == [together[n] for n in order]


def test_a_study_ends_fits_early_enough_and_not_too_early():
    """A thousandth of a standard deviation from where `output_error_batch` ends, which its own tests hold against single fits."""
    several = prepared(12)
    for one, outcome in zip(several, fit_together(several, {}), strict=True):
        assert outcome is not None
        found = est.output_error_batch(one.model, [one.recording], progress=False)
        for place, name in enumerate(FREE):
            value: Value = outcome.values[name]
            assert abs(value.value - found.values[0, place]) < 0.002 * value.std
            assert value.std == pytest.approx(found.std[0, place], rel=0.01)
        levels = noise_levels(one.recording.experiments)
        left = max(rms[0] / levels[channel] for channel, rms in found.residual_std.items())
        assert outcome.quantities["residual"] == pytest.approx(left, rel=1e-4)


def test_what_the_batch_leaves_open_is_fitted_alone_and_disturbs_nobody(monkeypatch):
    """A start that diverges, and dry friction that is not there and goes to its bound."""
    several = prepared(3)
    broken = several[1]._replace(model=several[1].model.with_values({"spring_stiffness": 1e12}))
    without = prepared(3, cart_coulomb=0.0)
    chunk = [several[0], broken, several[2], *without]
    found = fit_together(chunk, {})
    assert found[1] is None
    assert [found[0], found[2]] == [fit_together([several[n]], {})[0] for n in (0, 2)]
    assert any(outcome is None for outcome in found[3:])
    alone: list[Prepared] = []

    def single(one: Prepared, options: object, start: str) -> Outcome:
        alone.append(one)
        return Outcome(verdict="alone")

    monkeypatch.setattr(fit_chunk, "_METHODS", {"output_error": single})
    ended = fit_chunk.fit_chunk(Estimate("output_error"), chunk, "truth")
    assert [one is not None for one in found] == [outcome.verdict != "alone" for outcome in ended]
    assert [id(one) for one in alone] == [id(one) for one, outcome in zip(chunk, found, strict=True) if outcome is None]


@pytest.mark.parametrize(
    ("options", "start", "expected"),
    [
        ({}, "truth", True),
        ({"steps": 20}, "truth", True),
        ({}, "paper", False),
        ({"from_model": False}, "truth", False),
        ({"tolerance": 1e-4}, "truth", False),
    ],
)
def test_the_study_alone_says_whether_fits_are_made_together(options, start, expected):
    assert suits(Estimate("output_error", options=options), start) is expected
    assert not suits(Estimate("prediction_error_nonlinear"), start)


def test_chunks_are_as_large_as_the_fits_and_memory_allow():
    assert per_chunk(SPEC) == 250
    assert per_chunk(dataclasses.replace(SPEC, model=Fitted(free=FREE))) == 25
    long = dataclasses.replace(DECAYS, free=6, duration=25.0)
    assert per_chunk(dataclasses.replace(SPEC, excitation=(long,))) == 66
    assert per_chunk(dataclasses.replace(SPEC, estimate=(*SPEC.estimate, Estimate("diagnosis")))) == 1


def test_models_simulated_together_are_those_simulated_alone():
    spec = small(repetitions=5, plant=Plant(truth="model", spread=0.1), excitation=(DECAYS, SPEC.excitation[1]))
    truths = [true_for(spec, index) for index in range(5)]
    together = recordings(spec, range(5), truths)
    for number in (0, 3, 4):
        (alone,) = recordings(spec, [number], truths[number : number + 1])
        one = together[number]
        assert not isinstance(one, str)
        assert not isinstance(alone, str)
        for name in one.names:
            for channel, signal in one[name].outputs.items():
                np.testing.assert_array_equal(signal.values, alone[name].outputs[channel].values)
