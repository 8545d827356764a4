"""Saved models on the command line: a fit of the same data is used as it stands, another model is fitted to them."""

import dataclasses
import inspect
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from command_line import call, refused
from made_up_results import compared
from small_experiments import forced, free, rest
from users_effects import MagneticSpring

import estimators as est
import estimators.cli.control
import rtac_jax as rtac
from estimators.cli import job, models
from estimators.core.data import mark_of
from estimators.core.fisher_information import Information
from estimators.validation.simulation_error import Comparison
from rtac_jax.effects import CubicSpring
from rtac_jax.measurement import Recording

IMPORTS = ("from typing import ClassVar", "from rtac_jax import parameter", "from rtac_jax.effects import Force")
MODEL = (rtac.RTAC.paper() + CubicSpring(8e4)).fix("total_mass")


def recording():
    return Recording((free(), forced(), forced("forced_2"), rest()), {"total_mass": 1.23, "arm_inertia": 9.5e-5})


def fit_of(*experiments):
    count = len(MODEL.free)
    information = Information(MODEL.free, 1e-6 * np.eye(count), np.eye(count), np.full(count, 0.01))
    return est.Fit(
        MODEL, est.RESULTS.successful, information, {"cart_position": 1e-5}, {"cart_position": 1e-5}, {},
        tuple(e.name for e in experiments), {"agreed": 1, "starts": 1}, {e.name: mark_of(e) for e in experiments},
    )  # fmt: skip


@pytest.fixture
def work(tmp_path):
    recording().save(tmp_path / "rig.h5")
    with job.job(tmp_path / "rig.h5", "forced_2") as made:
        yield made


@pytest.fixture
def fitted(monkeypatch):
    """What was fitted from which model; the fit itself has tests of its own."""
    found = []

    def output_error(model, train, **options):
        found.append((model, train.names, options.get("from_model", False)))
        return "another fit"

    monkeypatch.setattr(est, "output_error", output_error)
    return found


def test_a_fit_of_the_same_data_is_used_as_it_stands(work, fitted, tmp_path):
    fit_of(*(e for e in work.train if e.kind != "rest")).save(tmp_path / "fit.h5")
    found = models.base_fit(work, tmp_path / "fit.h5")
    assert isinstance(found, est.Fit)
    assert str(found.model) == str(MODEL)
    assert not fitted
    assert work.remark.endswith("The fit is that of fit.h5.")


@pytest.mark.parametrize("other", ["fewer", "changed", "model", "improvement"])
def test_another_model_is_fitted_from_its_values(work, fitted, tmp_path, other):
    first, second = (e for e in work.train if e.kind != "rest")
    if other == "fewer":
        fit_of(first).save(tmp_path / "it.h5")
    elif other == "changed":
        fit_of(first, forced(second.name, cart_position=np.arange(2000.0))).save(tmp_path / "it.h5")
    elif other == "model":
        MODEL.save(tmp_path / "it.h5")
    else:
        from made_up_results import improvement

        dataclasses.replace(improvement(), fits=(fit_of(first), fit_of(first))).save(tmp_path / "it.h5")
    assert models.base_fit(work, tmp_path / "it.h5") == "another fit"
    ((model, names, from_model),) = fitted
    assert str(model) == str(MODEL)
    assert (names, from_model) == (("free", "forced", "rest"), True)
    assert "The model of it.h5 was fitted to this recording, from its values on." in work.remark


def test_of_an_improvement_that_random_forces_lead_astray_the_model_by_predictions_counts(tmp_path):
    from made_up_loop import made
    from made_up_results import improvement

    predicted = made(est.PredictorFit, model=MODEL.with_values({"spring_stiffness": 140.0}))
    whole = dataclasses.replace(improvement(), by_predictions=predicted)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "loaded", lambda *_: whole)
        assert float(models.model_or_fit(tmp_path / "it.h5")["spring_stiffness"]) == 140.0
        patch.setattr(models, "loaded", lambda *_: dataclasses.replace(whole, by_predictions=None))
        assert models.model_or_fit(tmp_path / "it.h5") is whole.final


def test_a_fit_by_predictions_knows_its_experiments_by_name():
    from made_up_loop import made

    predicted = made(est.PredictorFit, model=MODEL, experiments=("forced", "somewhere else"))
    assert models.seen(predicted, recording()) == ["forced"]
    assert models.seen(MODEL, recording()) == []


def test_experiments_that_a_judged_fit_has_seen_are_named(tmp_path, monkeypatch):
    recording().save(tmp_path / "rig.h5")
    fit_of(recording()["forced_2"]).save(tmp_path / "greedy.h5")
    heard = []

    def compared(work, fits, labels, ahead=None):
        heard.append(work.remark)
        raise ValueError("that is enough.")

    monkeypatch.setattr(job.Job, "compared", compared)
    MODEL.save(tmp_path / "plain.h5")
    arguments = ("--model", tmp_path / "greedy.h5", "--model", tmp_path / "plain.h5", "--validation", "forced_2")
    refused(call("compare", tmp_path / "rig.h5", *arguments), 1, "that is enough")
    assert heard == [
        "Held out: forced_2.\ngreedy was fitted to forced_2, which are held out here, so its error there is too good."
    ]


def test_a_controller_is_designed_for_a_fit_of_another_recording(tmp_path, monkeypatch, fitted):
    recording().save(tmp_path / "conditions.h5")
    fit_of(free("elsewhere")).save(tmp_path / "better.h5")
    used = SimpleNamespace(responses=[SimpleNamespace(name="forced")])
    taken = []

    def control(fit, *_, **__):
        taken.append(fit)
        raise ValueError("that is enough.")

    monkeypatch.setattr(estimators.cli.control, "enveloped", lambda *_, **__: (used, []))
    monkeypatch.setattr(est, "control", control)
    refused(call("control", tmp_path / "conditions.h5", "--model", tmp_path / "better.h5"), 1, "that is enough")
    assert taken[0].experiments == ("elsewhere",)
    assert str(taken[0].model) == str(MODEL)
    assert not fitted


@pytest.mark.parametrize(("error", "said"), [(1.0, False), (3000.0, True)])
def test_a_model_that_does_not_follow_the_recording_is_named_first(error, said):
    words = estimators.cli.control._does_not_follow(Comparison((compared("model", error),)))
    assert bool(words) is said
    assert not said or words[0].startswith("The model does not follow this recording")


def test_standard_output_is_no_file(tmp_path):
    recording().save(tmp_path / "rig.h5")
    refused(call("info", tmp_path / "rig.h5", "--json", "-"), 2, "--json", "name a file")


def test_a_model_with_an_effect_of_ones_own_needs_its_file(tmp_path):
    recording().save(tmp_path / "rig.h5")
    source = "\n".join((*IMPORTS, "", inspect.getsource(MagneticSpring)))
    (tmp_path / "mine.py").write_text(source)
    names: dict = {"__name__": "session"}
    exec(source, names)
    (rtac.RTAC.paper() + names["MagneticSpring"](1e6)).save(tmp_path / "own.h5")
    refused(
        call("improve", tmp_path / "rig.h5", "--model", tmp_path / "own.h5"), 2, "the effect magnetic_spring of your own",
        "--effects FILE.py",
    )  # fmt: skip
    found = models.model_or_fit(tmp_path / "own.h5", tmp_path / "mine.py")
    assert found.ids[-1] == "magnetic_spring"
    assert float(found["magnetic_spring.stiffness"]) == 1e6


def test_effects_are_added_in_a_size_that_the_recording_could_have(work):
    model = models.start_model(work, None, add=" cubic_spring, arm_coulomb")
    assert {"cubic_spring", "arm_coulomb"} <= set(model.ids)
    assert float(model["cubic_spring.stiffness"]) > 0.0
    held = models.start_model(work, None, fix="cubic_spring.stiffness=30", add="cubic_spring")
    assert "cubic_spring.stiffness" not in held.free
    assert float(held["cubic_spring.stiffness"]) == 30.0


@pytest.mark.parametrize(
    ("add", "said"),
    [
        ("cubic_sprung", "--add cubic_sprung: there is no such effect; did you mean cubic_spring?"),
        ("xyz", "--add xyz: there is no such effect; give one of cart_viscous, "),
        ("cart_viscous", "--add cart_viscous: the model has it already; leave that out."),
    ],
)
def test_what_cannot_be_added_is_a_sentence(work, capsys, add, said):
    with pytest.raises(typer.Exit):
        models.start_model(work, None, add=add)
    assert said in " ".join(capsys.readouterr().err.split())
