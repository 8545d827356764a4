"""Results come back from their files, and show themselves in a line and a small table."""

import dataclasses

import numpy as np
import pytest
from made_up_results import diagnosis, improvement

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import Information
from rtac_jax.effects import CubicSpring


def fit():
    """A fit as `output_error` returns it, of numbers that are made up."""
    model = (rtac.RTAC.paper() + CubicSpring(8e4)).fix("total_mass")
    count = len(model.free)
    covariance = np.diag(np.linspace(0.01, 0.02, count) ** 2)
    information = Information(
        model.free, covariance, np.eye(count), np.full(count, 0.01), np.ones((2, count, count)), None
    )
    return est.Fit(
        model, est.RESULTS.starts_disagree, information, {"cart_position": 2e-6}, {"cart_position": 3e-6},
        {"free_1": np.array([0.1, 0.0, 1 / 3, 0.0])}, ("free_1", "free_2"),
        {"agreed": 1, "starts": 2, "substeps": 3, "cost": 0.1, "seconds": np.float64(1.5)}, {"free_1": "abc"},
    )  # fmt: skip


def covered():
    random = np.random.default_rng(0)
    omega = np.linspace(2, 40, 40)
    plants = np.stack([1 / ((1j * omega) ** 2 + 2 * z * 10 * 1j * omega + 100) for z in random.uniform(0.05, 0.1, 5)])
    return est.envelope(plants, omega=omega, order_nominal=2, order_weight=2, within_db=40.0, progress=False)


@pytest.fixture(scope="module")
def results():
    return {
        "fit": fit(), "diagnosis": diagnosis("unknown"), "ambiguous": diagnosis("ambiguous"), "improvement": improvement(),
        "comparison": improvement().train, "envelope": covered(),
    }  # fmt: skip


NAMES = ("fit", "diagnosis", "ambiguous", "improvement", "comparison", "envelope")


def same(here, there):
    """Whether two records hold the same bits, whatever they are made of."""
    assert type(here) is type(there)
    if isinstance(here, np.ndarray):
        return here.dtype == there.dtype and here.tobytes() == there.tobytes()
    if isinstance(here, tuple | list):
        return len(here) == len(there) and all(same(a, b) for a, b in zip(here, there, strict=True))
    if isinstance(here, dict):
        return list(here) == list(there) and all(same(here[name], there[name]) for name in here)
    if isinstance(here, rtac.RTAC):
        return str(here) == str(there) and all(
            np.asarray(here[name]).tobytes() == np.asarray(there[name]).tobytes() for name in here.parameters
        )
    if dataclasses.is_dataclass(here):
        return all(same(getattr(here, f.name), getattr(there, f.name)) for f in dataclasses.fields(here))
    return bool(here == there) or (here != here and there != there) or str(here) == str(there)


@pytest.mark.parametrize("name", NAMES)
def test_a_result_comes_back_bit_for_bit(results, name, tmp_path):
    result = results[name]
    result.save(tmp_path / "result.h5")
    loaded = est.load(tmp_path / "result.h5")
    assert same(loaded, result)
    assert str(loaded) == str(result)
    assert loaded._repr_html_() == result._repr_html_()


@pytest.mark.parametrize(
    "name", ["diagnosis", *(pytest.param(name, marks=pytest.mark.slow) for name in ("comparison", "envelope"))]
)
def test_what_was_loaded_draws_the_same_picture(results, name, tmp_path):
    results[name].save(tmp_path / "result.h5")
    for number, one in enumerate((results[name], est.load(tmp_path / "result.h5"))):
        one.plot().savefig(tmp_path / f"{number}.png", metadata={"Software": None})
    assert (tmp_path / "0.png").read_bytes() == (tmp_path / "1.png").read_bytes()


def test_an_envelope_of_its_file_answers_as_before(results, tmp_path):
    results["envelope"].save(tmp_path / "envelope.h5")
    loaded = est.load(tmp_path / "envelope.h5")
    omega = np.linspace(1, 100, 37)
    assert np.array_equal(loaded.nominal_response(omega), results["envelope"].nominal_response(omega))
    assert np.array_equal(loaded.weight_magnitude(omega), results["envelope"].weight_magnitude(omega))
    assert loaded.nominal.name == "P0"


def test_a_result_is_not_loaded_without_its_package(results, tmp_path):
    results["fit"].save(tmp_path / "fit.h5")
    with pytest.raises(
        est.ResultFileError, match=r"holds a Fit of the package estimators; load it with estimators\.load"
    ):
        rtac.load(tmp_path / "fit.h5")


@pytest.mark.parametrize("name", NAMES)
def test_as_the_last_line_of_a_cell_it_is_short(results, name):
    result = results[name]
    assert len(repr(result).splitlines()) == 1
    assert len(repr(result)) < 200
    assert "f64[" not in repr(result)
    shown = result._repr_html_()
    assert 1 <= shown.count("<tr>") <= 13 or name == "diagnosis"  # of an unknown one there is nothing to tabulate
    assert shown.count("<table>") == shown.count("</table>")


def test_a_recording_and_a_model_are_short_too():
    free = [
        rtac.Experiment.of(f"<b>{n}", kind="free", sample_time=0.01, cart_position=np.arange(20.0)) for n in range(20)
    ]
    recording = rtac.Recording(tuple(free), {"total_mass": 1.23}, comment="a & b")
    assert repr(recording) == "Recording: 20 experiments (20 free)"
    shown = recording._repr_html_()
    assert "<b>0" not in shown
    assert "&lt;b&gt;0" in shown
    assert "a &amp; b" in shown
    assert shown.count("<tr>") == 13
    assert "8 more" in shown
    model = rtac.RTAC.paper()
    assert repr(model) == "RTAC: rigid body with cart_viscous, cart_coulomb, arm_viscous; 9 of 9 parameters are free"
    assert "spring_stiffness" in model._repr_html_()
