"""What contradicts itself in a recording is said before a result is believed; `--robust` reaches the fit."""

import dataclasses

import numpy as np
import pytest
from command_line import call, refused
from spoilt_recordings import FORCED, MOMENTARY, OF_CHANNELS, in_one

import estimators
from estimators.cli.doubts import explaining, warn
from estimators.cli.job import Job
from estimators.core.results import DivergedError
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.virtual_rig import Rig, record, standard_plans

TURNED = f"experiment {FORCED} disagrees with all others"


@pytest.fixture(scope="module")
def clean():
    return record(Rig(), standard_plans(seed=3, duration=4.0, free=2, forced=3), seed=4, step=5e-4)


@pytest.fixture(scope="module")
def spoilt(clean):
    """A velocity that counts backwards, and a dropout of the position."""
    recording = in_one(clean, FORCED, OF_CHANNELS["sign of velocity"][0])
    return in_one(recording, *MOMENTARY["position zero"][:2])


@pytest.fixture(scope="module")
def file(spoilt, tmp_path_factory):
    path = tmp_path_factory.mktemp("spoilt") / "rig.h5"
    spoilt.save(path)
    return path


def test_info_names_the_mistake(file):
    said = " ".join(call("info", file).stdout.split())
    assert TURNED in said
    assert "its arm_velocity fits with the sign swapped" in said
    assert "cart_position is exactly zero for 50 samples from sample 500 on" in said


def test_the_result_carries_the_doubts(clean, spoilt, tmp_path):
    work = Job("rig.h5", spoilt, None, None, None, 0.0)
    work.note_doubts()
    work.note_doubts()
    assert work.remark.count("Doubtful: ") == len(work.doubts) == 2
    assert TURNED in work.remark
    fine = Job("rig.h5", clean, None, None, None, 0.0)
    fine.note_doubts()
    assert fine.doubts == []
    assert "Doubtful" not in fine.remark


def test_doubts_come_before_a_failing_verdict_and_after_any_other(clean, spoilt, capsys):
    work = Job("rig.h5", spoilt, None, None, None, 0.0)
    warn(work.note_doubts())
    told = capsys.readouterr().err
    assert TURNED in told
    assert told.count("rtac: Doubtful: ") == 2
    first, remark, verdict = work.ordered("unknown", "The model fails.")
    assert first.endswith("mend this first.")
    assert TURNED in remark
    assert verdict == "The model fails."
    assert work.ordered("adequate", "Nothing is missing.") == ["Nothing is missing.", work.remark]
    fine = Job("rig.h5", clean, None, None, None, 0.0)
    warn(fine.note_doubts())
    assert capsys.readouterr().err == ""
    assert fine.ordered("unknown", "The model fails.") == ["The model fails.", fine.remark]


def test_a_cart_without_a_sensor_is_said_beside_the_result(clean):
    bare = tuple(dataclasses.replace(e, outputs={"arm_velocity": e.outputs["arm_velocity"]}) for e in clean)
    work = Job("rig.h5", dataclasses.replace(clean, experiments=bare), None, None, None, 0.0)
    work.note_doubts()
    work.note("No prediction error: they are free.")
    held, unmeasured, *_, last = work.remark.splitlines()
    assert held.startswith("Held out: ")
    assert (
        "cart_position was not measured, so the cart's friction, the spring and the mass show only through"
        in unmeasured
    )
    assert last == "No prediction error: they are free."


def test_deviations_that_cannot_be_had_are_a_note(clean, monkeypatch):
    def free(*_):
        raise estimators.NotIdentifiableError("covariances: they are free.")

    monkeypatch.setattr(estimators, "covariances", free)
    work = Job("rig.h5", clean, None, None, None, 0.0)
    assert work.spread("a fit") is None
    assert work.remark.splitlines()[-1] == "No covariances: they are free."


def test_a_fit_that_fails_names_the_doubt(file, monkeypatch):
    def failing(*_, **__):
        raise estimators.NotIdentifiableError("It leaves all free.")

    monkeypatch.setattr(estimators, "output_error", failing)
    result = call("compare", file)
    refused(result, 1, "cart_position is exactly zero for 50 samples")
    assert result.stderr.strip().endswith("As it is, no fit comes of it: It leaves all free.")


def test_robust_reaches_the_fit(file, monkeypatch):
    asked = []

    def fitted(*_, **options):
        asked.append(options.get("robust", False))
        raise ValueError("that is enough.")

    monkeypatch.setattr(estimators, "output_error", fitted)
    for flags in ([], ["--robust"]):
        refused(call("fit", file, *flags), 1, "that is enough")
    assert asked == [False, True]


def test_a_constant_that_no_rig_has_is_a_concern_of_info(clean, tmp_path):
    dataclasses.replace(clean, rig={"total_mass": 1e300}).save(tmp_path / "rig.h5")
    assert "total_mass is 1e+300 kg (the paper's is 1.23), which no rig has" in " ".join(
        call("info", tmp_path / "rig.h5").stdout.split()
    )


def test_what_the_equations_alone_contradict_is_taken_back_and_nothing_else(spoilt) -> None:
    work = Job("rig.h5", spoilt, None, None, None, 0.0)
    work.note_doubts()
    before, taken_back = work.remark.splitlines(), work.inconsistencies
    kept = [one for one in work.doubts if one not in taken_back]
    assert taken_back
    assert kept
    work.withdraw_inconsistencies()
    assert work.doubts == kept
    assert work.remark.splitlines() == [line for line in before if not any(one in line for one in taken_back)]
    assert len(work.remark.splitlines()) == len(before) - len(taken_back)
    work.withdraw_inconsistencies()
    assert work.doubts == kept


def test_a_fit_that_diverges_says_at_whose_mass_and_inertia_it_began():
    """A gantry of 25 times the paper's inertia, whose size nobody gave."""
    time = 0.004 * np.arange(300)
    run = Experiment.of(
        "run", kind="forced", sample_time=0.004, disturbance_force=np.sin(3 * time), cart_position=0.01 * np.sin(3 * time),
        arm_angle=0.1 * np.sin(3 * time),
    )  # fmt: skip

    def ended(rig: dict[str, float]) -> str:
        with pytest.raises(DivergedError) as caught, explaining(Recording((run,), rig), []):
            raise DivergedError("It diverges.")
        return str(caught.value)

    said = ended({"eccentric_moment": 0.0226})
    assert "It diverges. The fit began at the paper's total_mass = 1.23 kg and arm_inertia = 9.5e-05 kg m^2" in said
    assert "--rig total_mass=... --rig total_mass_std=..." in said
    assert "began at the paper's arm_inertia = " in ended({"total_mass": 1.3})
    assert ended({"total_mass": 1.3, "arm_inertia": 2e-3, "arm_inertia_std": 2e-4}) == "It diverges."
