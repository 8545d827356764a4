"""What a study says of estimators, envelopes and diagnoses, against truth that nobody but the study knows."""

import csv
import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t as student
from small_study import small

import estimators as est
from estimators.study import Estimate, Excitation, Fitted, Hidden, Noise, Plant, StudyResults, fit_chunk
from estimators.study.naming import outcome
from estimators.study.outcome import Prepared
from estimators.study.recordings import recordings
from estimators.study.repetition import layout_of
from estimators.study.statistics import clopper_pearson
from estimators.study.truth import true_for
from rtac_jax import RTAC

QUIET = {"progress": False}
DECAYS = Excitation(duration=2.0, free=2, forced=0, rest=1)
FREE = ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level")


def made_up(count: int, bias: float, factor: float) -> StudyResults:
    """Normal estimates around a truth of 2, with a bias and stated standard deviations off by a factor."""
    spec = small(repetitions=count, estimate=(Estimate("output_error"),), model=Fitted(free=("spring_stiffness",)))
    layout = layout_of(spec)
    arrays = layout.empty(count)
    random = np.random.default_rng(1)
    arrays["truth"][:] = 2.0
    arrays["estimate"][:, 0, 0] = 2.0 + bias + 0.1 * random.standard_normal(count)
    arrays["std"][:, 0, 0], arrays["freedom"][:, 0, 0] = 0.1 * factor, np.inf
    return StudyResults(spec, np.arange(count), layout, arrays)


@pytest.mark.parametrize(("bias", "factor", "covered"), [(0.0, 1.0, 0.95), (0.1, 1.0, 0.830), (0.0, 0.5, 0.673)])
def test_the_summary_of_known_numbers(bias, factor, covered):
    found = made_up(4000, bias, factor).summary()
    at = {name: float(one.sel(estimator="output_error", parameter="spring_stiffness")) for name, one in found.items()}
    assert at["bias"] == pytest.approx(bias, abs=4 * at["bias_std"])
    assert at["bias_std"] == pytest.approx(0.1 / np.sqrt(4000), rel=0.05)
    assert at["std"] == pytest.approx(0.1, rel=0.05)
    assert at["rms_error"] == pytest.approx(np.hypot(0.1, bias), rel=0.05)
    assert at["stated_std"] == pytest.approx(0.1 * factor)
    assert at["coverage_low"] < covered < at["coverage_high"]
    assert at["coverage_high"] - at["coverage_low"] < 0.04
    assert at["count"] == 4000


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1.0, "as it says"), (0.5, "too short by output_error for 1 of 1"), (2.0, "too long by output_error for 1 of 1")],
)
def test_the_picture_tells_intervals_that_are_too_short_from_those_too_long(factor: float, words: str) -> None:
    figure = made_up(400, 0.0, factor).plot("coverage")
    assert words in " ".join(text.get_text().replace("\n", " ") for text in [figure._suptitle, *figure.texts] if text)


def test_clopper_and_pearson():
    low, high = clopper_pearson(np.array([0, 5, 10, 0]), np.array([10, 10, 10, 0]))
    np.testing.assert_allclose(low[:3], [0.0, 0.18709, 0.69150], atol=1e-5)
    np.testing.assert_allclose(high[:3], [0.30850, 0.81291, 1.0], atol=1e-5)
    assert np.isnan(low[3])


def test_results_have_names_and_are_written(tmp_path):
    found = made_up(30, 0.0, 1.0)
    assert found["estimate"].axes == ("repetition", "estimator", "parameter")
    assert found["estimate"].sel(repetition=3, estimator="output_error").values.shape == (1,)
    with pytest.raises(KeyError, match="there is no 'mass'; there are spring_stiffness"):
        found["truth"].sel(parameter="mass")
    with pytest.raises(KeyError, match="there is no variable 'estimates'"):
        found["estimates"]
    assert set(found.dataset) == set(found.arrays)
    assert not set(found.layout.variables) & {"repetition", *found.layout.coordinates}, (
        "xarray allows no variable of an axis's name"
    )
    found.to_csv(tmp_path / "summary.csv")
    rows = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert [(row["estimator"], row["parameter"]) for row in rows] == [("output_error", "spring_stiffness")]
    assert float(rows[0]["count"]) == 30
    assert {path.name for path in tmp_path.iterdir()} == {"summary.csv"}
    report = found.report(tmp_path / "report")
    assert "95 % intervals cover" in report.read_text()
    found.to_csv(tmp_path / "all.csv", repetitions=True)
    assert len(list(csv.DictReader((tmp_path / "all.csv").read_text().splitlines()))) == 30


def test_without_xarray_the_dataset_is_a_dictionary(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert type(made_up(3, 0.0, 1.0).dataset) is dict


@pytest.mark.slow
def test_intervals_of_output_error_hold_the_truth_of_the_model_itself():
    spec = small(
        repetitions=40,
        plant=Plant(truth="model", spread=0.1),
        excitation=(DECAYS,),
        model=Fitted(free=FREE, start="truth"),
        estimate=(Estimate("output_error"),),
    )
    found = est.study(spec, **QUIET)
    assert found["truth"].coordinates["parameter"] == FREE
    assert float(found.failure_rate.sel(estimator="output_error")) == 0
    assert set(found["verdict"].values[:, 0]) == {"successful"}
    summary = found.summary()
    for name in FREE:
        at = {n: float(one.sel(estimator="output_error", parameter=name)) for n, one in summary.items()}
        assert abs(at["bias"]) < 4 * at["bias_std"]
        assert at["std"] == pytest.approx(at["stated_std"], rel=0.35)
        assert at["coverage_low"] < 0.95 <= at["coverage_high"]


@pytest.mark.slow
def test_random_forces_are_more_than_output_error_states():
    spec = small(
        repetitions=30,
        excitation=(DECAYS,),
        noise=Noise(force=3e-3),
        model=Fitted(free=FREE, start="truth"),
        estimate=(Estimate("output_error"),),
    )
    summary = est.study(spec, **QUIET).summary()
    assert np.all(summary["coverage"].values < 0.8)
    assert np.all(summary["std"].values > 2 * summary["stated_std"].values)


@pytest.mark.parametrize(
    ("hidden", "verdict", "named", "worth"),
    [
        ("tacho_lag", "missing", "tacho_lag", "right"),
        ("tacho_lag", "ambiguous", "channel_delay|tacho_lag", "in the group"),
        ("tacho_lag", "missing", "cogging", "wrong"),
        ("tacho_lag", "missing", "tacho_lag + cogging", "right and more"),
        ("tacho_lag", "unknown", "", "unknown"),
        ("tacho_lag", "adequate", "", "adequate"),
        ("cubic_spring + arm_coulomb", "missing", "arm_coulomb + cubic_spring", "right"),
        ("cubic_spring + arm_coulomb", "missing", "arm_coulomb", "a part"),
        ("nothing", "adequate", "", "right"),
        ("nothing", "missing", "cogging", "wrong"),
        ("outside: eddy brake", "missing", "arm_coulomb", "wrong"),
    ],
)
def test_what_a_diagnosis_was_worth(hidden, verdict, named, worth):
    assert outcome(hidden, verdict, named) == worth


def test_hidden_against_named():
    spec = small(
        repetitions=6,
        estimate=(Estimate("diagnosis"),),
        plant=Plant(hidden=(Hidden("nothing"), Hidden("arm_coulomb", {"arm_coulomb": 4e-4}))),
    )
    layout = layout_of(spec)
    arrays = layout.empty(6)
    arrays["hidden"][:] = ["nothing", "arm_coulomb"] * 3
    arrays["excitation"][:] = "standard"
    arrays["verdict"][:, 0] = ["adequate", "missing", "missing", "ambiguous", "adequate", ""]
    arrays["named"][:, 0] = ["", "arm_coulomb", "cogging", "arm_stribeck|arm_coulomb", "", ""]
    arrays["reason"][5, 0] = "DivergedError: gone"
    found = StudyResults(spec, np.arange(6), layout, arrays)
    hidden, named, share = found.confusion()
    assert hidden == ("nothing", "arm_coulomb")
    assert named == ("arm_coulomb", "cogging", "adequate", "failed")
    np.testing.assert_allclose(share, [[0, 1 / 3, 2 / 3, 0], [2 / 3, 0, 0, 1 / 3]])
    assert [row[2:10] for row in found.naming().rows] == [
        ("2", "", "", "", "", "", "1", ""),
        ("1", "", "1", "", "", "", "", "1"),
    ]
    assert found.plot().get_suptitle().replace("\n", " ") == (
        "The hidden effect is named in 2 of 3 repetitions; 1 false alarms in 3 with nothing hidden"
    )


@pytest.mark.slow
def test_a_diagnosis_is_made_on_what_is_hidden():
    """One repetition, with two candidates: the whole catalogue is the diagnosis's own test."""
    spec = small(
        repetitions=1,
        plant=Plant(hidden=(Hidden("cubic_spring", {"cubic_spring": 5e4}),)),
        excitation=(Excitation(duration=3.0, free=2, forced=0, rest=1),),
        estimate=(
            Estimate("diagnosis", options={"candidates": ["cubic_spring", "cart_quadratic_drag"], "thorough": False}),
        ),
    )
    found = est.study(spec, **QUIET)
    assert not found["reason"].values[0, 0]
    assert found["named"].values[0, 0] == "cubic_spring"
    assert found.confusion()[2].tolist() == [[1.0]]


@pytest.mark.slow
def test_new_conditions_are_held_against_an_envelope():
    spec = small(
        repetitions=2,
        noise=Noise(encoder=True, position=2e-6, bits=16),
        excitation=(
            Excitation(
                kind="conditions", duration=20.0, sample_time=0.02, conditions=5, new_conditions=4, current_rms=0.1
            ),
        ),
        estimate=(Estimate("envelope", options={"order_nominal": 2, "held_out": [3, 4], "within_db": 40.0}),),
    )
    found = est.study(spec, **QUIET)
    assert found.failures == {"envelope": {}}
    said = found.envelope_coverage()
    assert said["stated"] == pytest.approx(0.05**0.5)  # Wilks, of two held out
    assert said["confidence"] == 0.95
    assert 4 * said["inside"] % 0.5 == 0  # of two envelopes and four conditions each
    assert "new condition lies inside" in str(found)


def test_a_failure_of_the_machine_is_none_of_the_study(monkeypatch):
    def no_memory(*arguments):
        raise MemoryError

    monkeypatch.setattr(fit_chunk, "_METHODS", {"least_squares": no_memory})
    with pytest.raises(MemoryError):
        est.study(small(repetitions=1), **QUIET)


def test_the_ready_studies_are_read():
    files = sorted((Path(__file__).parents[2] / "studies").glob("*.toml"))
    assert [file.stem for file in files] == ["coverage", "diagnosis", "envelope", "estimates", "excitation"]
    for file in files:
        spec = est.StudySpec.load(file)
        assert spec.name == file.stem
        assert spec.question.endswith("?")
        assert dataclasses.replace(spec, repetitions=1).digest == spec.digest


def test_conditions_whose_mode_has_no_damping_do_not_count(monkeypatch):
    """Of a mode that only the bound on stability keeps next to no deviation is stated: weighed by it, nothing else counted."""
    plain = np.array([10.4, 10.6, 10.5]), np.array([0.020, 0.024, 0.023])
    stds = np.array([[0.05, 0.1, 0.05], [0.002, 0.004, 0.002]])

    def model(number: int | None) -> SimpleNamespace:
        names = ("natural frequency [rad/s]", "damping ratio")
        if number is None:
            return SimpleNamespace(names=names, values=(9.0, 4e-15), std=(1e-3, 1e-16), undamped=True, converged=True)
        values, std = (plain[0][number], plain[1][number]), stds[:, number]
        return SimpleNamespace(names=names, values=values, std=std, undamped=False, converged=True)

    spec = small()
    truth = true_for(spec, 0)
    (recording,) = recordings(spec, [0], [truth])
    prepared = Prepared(RTAC.paper(), recording, truth)
    found = SimpleNamespace(models=[model(0), model(None), model(1), model(2)])
    monkeypatch.setattr(fit_chunk, "prediction_error", lambda *_, **__: found)
    outcome = fit_chunk._METHODS["prediction_error"](prepared, {}, "paper")
    for row, name in enumerate(fit_chunk.LINEAR):
        weights = stds[row] ** -2
        mean = np.sum(weights * plain[row]) / np.sum(weights)
        assert outcome.values[name].value == pytest.approx(mean)
        assert abs(mean - 9.0) > 1.0 or name != "natural frequency"
    assert outcome.quantities == {"undamped": 1.0}
    found.models = [model(0), model(None)]
    with pytest.raises(ValueError, match="in 1 of 2 conditions a mode has no damping"):
        fit_chunk._METHODS["prediction_error"](prepared, {}, "paper")


@pytest.mark.parametrize("spread", [0.0, 0.5, 1.0])
def test_intervals_of_a_weighted_mean_hold_the_truth(spread):
    """Of conditions of equal and of unequal precision, with and without a scatter that none of them states (seed 0)."""
    random, held, count = np.random.default_rng(0), 0, 2000
    for repetition in range(count):
        std = np.exp(spread * random.standard_normal(10))
        values = np.hypot(std, repetition % 2) * random.standard_normal(10)
        one = fit_chunk._weighted_mean(values, std)
        held += abs(one.value) < student.ppf(0.975, one.freedom) * one.std
    assert 0.935 < held / count < 0.97
