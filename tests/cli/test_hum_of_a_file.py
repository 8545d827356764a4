"""Hum of the mains in a file: every command on a recording subtracts it, and says so."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import rtac_jax as rtac
from estimators.cli.job import job
from rtac_jax import virtual_rig
from rtac_jax.measurement import Experiment

SAID = re.compile(r"Hum of the mains was subtracted first: cart_position (3|2\.9|3\.1)e-05 m at 50 Hz\.")


def file_with_hum(path: Path, *, free: int, forced: int, duration: float) -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=2, duration=duration, sample_time=0.002, free=free, forced=forced, rest=1)
    clean = virtual_rig.record(virtual_rig.Rig(), plans, seed=2)

    def hummed(e: Experiment) -> Experiment:
        signal = e.outputs["cart_position"]
        wave = 3e-5 * np.cos(100 * np.pi * np.arange(e.samples) * e.sample_time)
        return dataclasses.replace(
            e, outputs=dict(e.outputs) | {"cart_position": dataclasses.replace(signal, values=signal.values + wave)}
        )

    recording = dataclasses.replace(clean, experiments=tuple(map(hummed, clean)))
    recording.save(path)
    return recording


@pytest.mark.parametrize(
    "shape", [{"free": 1, "forced": 2, "duration": 4.0}, {"free": 0, "forced": 1, "duration": 8.0}]
)
def test_a_command_works_without_it_and_says_so_also_where_it_divides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shape: dict[str, float]
) -> None:
    recording = file_with_hum(tmp_path / "rig.h5", **shape)
    with job(tmp_path / "rig.h5") as work:
        work.divide()
        assert SAID.search(work.remark)
        assert work.remark.startswith("Held out: ")
        assert SAID.search(capsys.readouterr().err)
        for name in ("rest_1", "forced_1"):
            there = next(e for e in work.recording if e.name.startswith(name)).outputs["cart_position"].values
            expected = recording.without_hum()[name].outputs["cart_position"].values[: len(there)]
            assert np.array_equal(there, expected)
            assert not np.array_equal(there, recording[name].outputs["cart_position"].values[: len(there)])


def test_of_a_file_without_hum_nothing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file_with_hum(tmp_path / "rig.h5", free=1, forced=1, duration=4.0).without_hum().save(tmp_path / "quiet.h5")
    with job(tmp_path / "quiet.h5") as work:
        assert "Hum" not in work.remark + capsys.readouterr().err
