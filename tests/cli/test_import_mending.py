"""`rtac import --mend`: what was lost is missing, in CSV files and in recordings that are added to."""

from pathlib import Path

import numpy as np
from typer.testing import CliRunner

import rtac_jax as rtac
from estimators.cli.app import app

STEP = 0.002


def test_lost_rows_and_clipped_samples_are_missing(tmp_path: Path) -> None:
    time = STEP * np.arange(1500)
    seen = np.round(np.clip(20 * np.exp(-0.1 * time) * np.cos(12 * time), -15, 15), 3)
    rows = np.delete(np.stack([1e3 * time, seen], axis=1), [400, 401], axis=0)
    (tmp_path / "run.csv").write_text("t_ms,x_mm\n" + "\n".join(f"{a:.6g},{b:.6g}" for a, b in rows))
    given = ["import", str(tmp_path / "run.csv"), "--kind", "free", "--time", "t_ms", "--channel", "cart_position=x_mm"]
    given += ["--arm", "locked", "--rig", "total_mass=1.5", str(tmp_path / "run.h5")]
    refused = CliRunner().invoke(app, given)
    assert refused.exit_code == 2
    assert "--mend of rtac import" in refused.output
    made = CliRunner().invoke(app, [*given, "--mend"])
    assert made.exit_code == 0, made.output
    values = rtac.Recording.load(tmp_path / "run.h5")["run"].outputs["cart_position"].values
    assert len(values) == 1500
    missing = np.flatnonzero(np.isnan(values))
    np.testing.assert_array_equal(missing, np.union1d(np.flatnonzero(np.abs(seen) >= 15), [400, 401]))


def test_a_recording_that_is_added_to_is_mended_too(tmp_path: Path) -> None:
    time = STEP * np.arange(1500)
    seen = np.clip(0.02 * np.exp(-0.1 * time) * np.cos(12 * time), -0.015, 0.015)
    one = rtac.Experiment.of("run", kind="free", sample_time=STEP, arm="locked", cart_position=seen)
    rtac.Recording([one], {"total_mass": 1.5}).save(tmp_path / "old.h5")
    for more, said, missing in (
        ([], "as they are", 0),
        (["--mend"], "mended", np.count_nonzero(np.abs(seen) >= 0.015)),
    ):
        out = str(tmp_path / f"new{len(more)}.h5")
        made = CliRunner().invoke(app, ["import", str(tmp_path / "old.h5"), out, *more])
        assert made.exit_code == 0, made.output
        assert f"come along {said}" in made.output
        values = rtac.Recording.load(out)["run"].outputs["cart_position"].values
        assert np.count_nonzero(np.isnan(values)) == missing
