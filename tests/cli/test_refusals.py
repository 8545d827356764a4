"""How the command line refuses: one sentence that names the place and the mend, and a status of its own."""

import pytest
from command_line import COMMANDS, call, refused

import estimators as est
from rtac_jax.measurement import Recording


@pytest.fixture
def bad_files(file, tmp_path):
    text = tmp_path / "text.h5"
    text.write_text("time,position\n0,1\n")
    cut = tmp_path / "cut.h5"
    cut.write_bytes(file.read_bytes()[:3000])
    return {"text": text, "cut": cut, "missing": tmp_path / "missing.h5", "folder": tmp_path}


@pytest.mark.parametrize("command", ["info", *COMMANDS])
@pytest.mark.parametrize("which", ["text", "cut", "missing", "folder"])
def test_an_unreadable_file_is_wrong_use(bad_files, command, which):
    refused(call(command, bad_files[which]), 2, str(bad_files[which]))


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_name_for_validation_is_wrong_use(file, command):
    refused(call(command, file, "--validation", "free_1,fred"), 2, "fred", "forced_2")
    refused(call(command, file, "--validation", ","), 2, "choose among")


def test_an_experiment_at_rest_cannot_validate(file):
    refused(call("fit", file, "--validation", "rest_1"), 2, "rest_1")


@pytest.mark.parametrize("option", ["--out", "--json"])
def test_a_place_that_cannot_be_written_is_wrong_use(file, option):
    # Below a file there can be no folder, whoever asks.
    refused(call("fit", file, option, file / "below" / "it"), 2, "cannot be written to")


def test_a_folder_is_no_json_file(file, tmp_path):
    refused(call("fit", file, "--json", tmp_path), 2, "folder")


def test_wrong_arguments_are_wrong_use(file):
    assert call("fit").exit_code == 2
    assert call("fit", file, "--nonsense").exit_code == 2
    assert call("nonsense").exit_code == 2


@pytest.mark.parametrize("command", COMMANDS)
def test_rest_records_alone_do_not_allow_it(recording, tmp_path, command):
    recording.select(["rest_1"]).save(tmp_path / "rest.h5")
    refused(call(command, tmp_path / "rest.h5"), 1)


def test_one_short_experiment_cannot_be_improved_upon(recording, tmp_path):
    short = recording["forced_1"].cut(0, 150)
    Recording((short, recording["rest_1"]), recording.rig).save(tmp_path / "one.h5")
    refused(call("improve", tmp_path / "one.h5"), 1, "nothing can be held out")


def test_a_constant_that_no_model_has_is_named(recording, tmp_path):
    Recording(recording.experiments, {"arm_length": 0.1}).save(tmp_path / "odd.h5")
    refused(call("fit", tmp_path / "odd.h5"), 2, "arm_length", "arm_inertia")


def test_an_unknown_scale_does_not_allow_it(recording, tmp_path):
    Recording(recording.experiments).save(tmp_path / "unscaled.h5")
    refused(call("fit", tmp_path / "unscaled.h5"), 1, "total_mass", "arm_inertia", "scale")


def test_an_interruption_has_a_status_of_its_own(file, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Recording, "load", staticmethod(interrupt))
    refused(call("info", file), 130, "interrupted")


@pytest.mark.parametrize("command", ["fit", "improve"])
@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("nonsense", "no parameter is called nonsense"),
        ("cart_coulomb.level=-1", "from 0 to inf N"),
        ("arm_viscous.positive,cart_coulomb.level=abc", "from 0 to inf N"),
    ],
)
def test_a_parameter_that_cannot_be_held_is_named(file, command, asked, said):
    refused(call(command, file, "--fix", asked), 2, "--fix", said)


def test_what_is_held_reaches_the_fit(file, monkeypatch):
    class FittedError(ValueError):
        pass

    def output_error(model, *_, **__):
        assert "cart_coulomb.level" not in model.free
        assert float(model["cart_coulomb.level"]) == 0.25
        assert "spring_stiffness" not in model.free
        raise FittedError("reached")

    monkeypatch.setattr(est, "output_error", output_error)
    refused(call("fit", file, "--fix", "cart_coulomb.level=0.25, spring_stiffness"), 1, "reached")
