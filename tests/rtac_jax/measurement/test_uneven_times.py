"""Rows at uneven times: brought to one clock, or rounded ones told from them."""

from pathlib import Path

import numpy as np
import pytest

from rtac_jax.measurement import Recording, RecordingError

RNG = np.random.default_rng(3)


def jittering(count: int = 400) -> np.ndarray:
    """Times of a loop that sleeps 5 ms and works for up to 2 ms more, with one gap of 40 ms."""
    steps = 0.005 + 0.002 * RNG.random(count - 1)
    steps[200] = 0.040
    return np.concatenate([[0.0], np.cumsum(steps)])


def written(path: Path, times: np.ndarray, digits: int = 6) -> Path:
    """A file with a sine that is driven by steps of half a second."""
    rows = np.column_stack([np.round(times, digits), np.floor(times / 0.5) % 2, 0.02 * np.sin(9.0 * times)])
    np.savetxt(path, rows, delimiter=",", header="t,i,x", comments="", fmt="%.9g")
    return path


def read(path: Path, **options: object) -> Recording:
    return Recording.from_csv(path, channels={"current": "i", "cart_position": "x"}, kind="forced", time="t", **options)  # pyright: ignore[reportArgumentType]


def test_rows_at_uneven_times_are_brought_to_one_clock(tmp_path: Path) -> None:
    times = jittering()
    path = written(tmp_path / "run.csv", times)
    with pytest.raises(RecordingError, match=r"bring the samples to one clock \(resample=, --resample"):
        read(path)
    run = read(path, resample=0.006)["run"]
    clock = 0.006 * np.arange(run.samples)
    assert run.sample_time == 0.006
    assert times[-1] - 0.006 < clock[-1] <= times[-1]
    position, truth = run.outputs["cart_position"].values, 0.02 * np.sin(9.0 * clock)
    # Straight lines over h leave h^2/8 times the second derivative.
    np.testing.assert_array_less(np.abs(position - truth)[~np.isnan(position)], 0.02 * 81 * 0.007**2 / 8 + 1e-8)
    in_gap = (clock > times[200] + 1e-6) & (clock < times[201] - 1e-6)
    assert np.array_equal(np.isnan(position), in_gap)
    amid = np.searchsorted(np.round(times, 6), clock + 0.003, side="right") - 1
    assert np.array_equal(run.inputs["current"].values, np.floor(times[amid] / 0.5) % 2), "held as amid its interval"


def test_rows_that_are_stamped_late_make_no_input_late(tmp_path: Path) -> None:
    """A loop on an exact clock whose rows are stamped up to a fifth of a step after what they say."""
    current = RNG.standard_normal(400)
    times = 0.005 * np.arange(400) + 0.001 * RNG.random(400)
    rows = np.column_stack([np.round(times, 6), current, np.sin(times)])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,i,x", comments="", fmt="%.9g")
    found = read(tmp_path / "run.csv", resample=0.005)["run"].inputs["current"].values
    assert len(found) >= 399
    np.testing.assert_allclose(found, current[: len(found)], rtol=1e-8)


def test_rows_that_are_written_twice_are_dropped_if_asked_and_others_are_not(tmp_path: Path) -> None:
    times = 0.005 * np.arange(100)
    rows = np.column_stack([times, np.arange(100) % 7, np.sin(times)])
    twice = np.insert(rows, [40, 41, 80], rows[[39, 40, 79]], axis=0)
    np.savetxt(tmp_path / "twice.csv", twice, delimiter=",", header="t,i,x", comments="", fmt="%.9g")
    with pytest.raises(
        RecordingError, match=r"index 40: the time does not increase; rows that say the same twice are dropped by"
    ):
        read(tmp_path / "twice.csv")
    run = read(tmp_path / "twice.csv", mend=True)["twice"]
    np.testing.assert_allclose(run.inputs["current"].values, rows[:, 1])
    np.testing.assert_allclose(run.outputs["cart_position"].values, rows[:, 2], rtol=1e-8)
    twice[40, 2] += 0.1
    np.savetxt(tmp_path / "other.csv", twice, delimiter=",", header="t,i,x", comments="", fmt="%.9g")
    with pytest.raises(RecordingError, match=r"index 40: the time does not increase; .* cut or correct others"):
        read(tmp_path / "other.csv", mend=True)


def test_an_input_between_whose_rows_straight_lines_are_asked(tmp_path: Path) -> None:
    run = read(written(tmp_path / "run.csv", jittering()), resample=0.006, intersample="foh")["run"]
    current = run.inputs["current"].values
    assert np.any((current > 0) & (current < 1))
    assert not np.any(np.isnan(current))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"resample": 0.02}, "resample: is 0.02 s, and the rows are 0.00[56].* apart; give about as much"),
        ({"resample": 0.0005}, "give about as much, or the noise of each row is counted several times"),
        ({"resample": -1.0}, "resample: the seconds between samples is -1, but must be positive"),
        ({"resample": 0.006, "time": None, "sample_time": 0.006}, "resample: needs the times of the rows"),
    ],
)
def test_what_cannot_be_resampled(tmp_path: Path, options: dict[str, object], said: str) -> None:
    path = written(tmp_path / "run.csv", jittering())
    with pytest.raises(RecordingError, match=said):
        Recording.from_csv(
            path, channels={"current": "i", "cart_position": "x"}, kind="forced", **{"time": "t", **options}
        )  # pyright: ignore[reportArgumentType]


def test_a_lost_frame_among_times_of_few_digits(tmp_path: Path) -> None:
    """Sixty frames a second with times in whole milliseconds: rounding takes them 3 % of a step off the clock."""
    times = np.arange(300) / 60.0
    assert read(written(tmp_path / "whole.csv", times, 3))["whole"].sample_time == pytest.approx(1 / 60, rel=1e-5)
    path = written(tmp_path / "lost.csv", np.delete(times, 120), 3)
    with pytest.raises(RecordingError, match=r"t, index 120: .* rows are missing there"):
        read(path)
    lost = read(path, mend=True)["lost"]
    assert lost.sample_time == pytest.approx(1 / 60, rel=1e-5)
    assert np.flatnonzero(np.isnan(lost.outputs["cart_position"].values)).tolist() == [120]


def test_jitter_of_a_long_recording_is_no_rounding(tmp_path: Path) -> None:
    """A hundred seconds into it a time is a hundred thousand milliseconds, and still not a whole number of them."""
    times = 100.0 + np.arange(200) / 60.0 + 4e-4 * (RNG.random(200) - 0.5)
    with pytest.raises(RecordingError, match="bring the samples to one clock"):
        read(written(tmp_path / "run.csv", times, 6))


def test_spikes_are_taken_out_before_rows_are_brought_to_a_clock(tmp_path: Path) -> None:
    times = np.cumsum(0.005 + 0.001 * RNG.random(800))
    position = 0.02 * np.sin(9.0 * times) + 1e-5 * RNG.standard_normal(800)
    position[[100, 250, 400, 555, 700]] += 0.05
    path = tmp_path / "run.csv"
    np.savetxt(
        path, np.column_stack([times, times > 1.0, position]), delimiter=",", header="t,i,x", comments="", fmt="%.9g"
    )
    mended = read(path, resample=0.0055, mend=True)["run"].outputs["cart_position"].values
    assert np.nanmax(np.abs(mended)) < 0.0205
    assert 5 <= np.count_nonzero(np.isnan(mended)) <= 15
    assert np.nanmax(np.abs(read(path, resample=0.0055)["run"].outputs["cart_position"].values)) > 0.04
