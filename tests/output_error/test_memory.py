"""What a fit takes is said before it begins, and refused where it is not there."""

import numpy as np
import pytest
from command_line import call, refused
from small_experiments import forced, free

import estimators as est
from estimators.core.results import TooLargeError
from estimators.output_error import memory
from estimators.output_error.memory import bytes_free, bytes_needed, require_memory
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording

RECORDING = Recording((free(), forced()), {"total_mass": 1.23, "arm_inertia": 9.5e-5})
MODEL = RTAC.from_rig(RECORDING)


def of_length(samples, count=1):
    wave = np.sin(1e-3 * np.arange(samples))
    one = Experiment.of("e", kind="free", sample_time=1e-3, cart_position=wave)
    return [one] * count


def test_the_estimate_grows_with_samples_and_experiments():
    needed = [bytes_needed(MODEL, of_length(samples)) for samples in (20_000, 200_000)]
    assert 5 < (needed[1] - 5e8) / (needed[0] - 5e8) < 20
    assert bytes_needed(MODEL, of_length(20_000, 20)) - 5e8 == pytest.approx(20 * (needed[0] - 5e8))
    # The targets: 20 experiments of 100,000 samples within 2 GB.
    assert bytes_needed(MODEL, of_length(100_000, 20)) < 2.5e9


def test_what_is_free_is_known_here():
    free_bytes = bytes_free()
    assert free_bytes is None or 0 <= free_bytes < 1 << 50


def test_a_small_recording_needs_no_word(monkeypatch):
    monkeypatch.setattr(memory, "bytes_free", lambda: 16 * 10**9)
    assert require_memory(MODEL, RECORDING.experiments) == ""
    monkeypatch.setattr(memory, "bytes_free", lambda: None)
    assert require_memory(MODEL, of_length(100_000)) == ""


def test_much_is_announced_wherever_there_is_more(monkeypatch):
    monkeypatch.setattr(memory, "bytes_free", lambda: 64 * 10**9)
    assert "2,000,000 samples in 20 experiment(s) take about" in require_memory(MODEL, of_length(100_000, 20))


def test_a_large_one_is_announced_and_one_too_large_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "bytes_free", lambda: 10**9)
    assert "4,000 samples in 2 experiment(s) take about 0.5" in require_memory(MODEL, RECORDING.experiments)
    monkeypatch.setattr(memory, "bytes_free", lambda: 10**8)
    with pytest.raises(
        TooLargeError, match=r"and 0\.1 GB are free; fit fewer experiments \(Recording\.select\), shorter"
    ):
        est.output_error(MODEL, RECORDING, progress=False)
    RECORDING.save(tmp_path / "rig.h5")
    refused(call("fit", tmp_path / "rig.h5"), 1, "4,000 samples", "GB are free", "Experiment.cut")


def test_the_command_line_says_it_beforehand(monkeypatch, tmp_path):
    def stops(*_, **__):
        raise ValueError("enough.")

    monkeypatch.setattr(memory, "bytes_free", lambda: 10**9)
    monkeypatch.setattr(est, "output_error", stops)
    RECORDING.save(tmp_path / "rig.h5")
    told = call("compare", tmp_path / "rig.h5")
    assert told.stderr.splitlines()[0].startswith("rtac: 4,000 samples in 2 experiment(s) take about 0.5")
    assert told.stderr.splitlines()[1] == "rtac: enough."
