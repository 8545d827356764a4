"""What a logger loses is put back as missing, what is no measurement becomes missing, and what is one stays."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.measurement import RecordingError, concerns
from rtac_jax.measurement._mending import places_of_rows

STEP = 0.002


def swing(samples: int = 2000, *, noise: float = 2e-6) -> np.ndarray:
    """A decaying swing of 20 mm at 2 Hz, as a sensor with white noise shows it."""
    time = STEP * np.arange(samples)
    return 0.02 * np.exp(-0.2 * time) * np.cos(4 * np.pi * time) + noise * np.random.default_rng(1).normal(size=samples)


def recording(position: np.ndarray, **more: str) -> rtac.Recording:
    one = rtac.Experiment.of("run", kind="free", sample_time=STEP, arm="locked", cart_position=position, **more)  # pyright: ignore[reportArgumentType]
    return rtac.Recording([one])


def position_of(found: rtac.Recording) -> np.ndarray:
    return found["run"].outputs["cart_position"].values


def test_what_lies_beyond_a_range_becomes_missing_and_nothing_else() -> None:
    whole = swing()
    clipped = recording(np.clip(whole, -0.012, 0.015))
    assert any("as where the range of the sensor ends" in sentence for sentence in concerns(clipped))
    beyond = (whole > 0.015) | (whole < -0.012)
    np.testing.assert_array_equal(np.isnan(position_of(clipped.mended())), beyond)
    np.testing.assert_array_equal(position_of(clipped.mended())[~beyond], whole[~beyond])


def test_only_the_end_that_is_reached_is_named() -> None:
    (said,) = [s for s in concerns(recording(np.minimum(swing(), 0.015))) if "range of the sensor" in s]
    assert "stays at exactly 0.015 m for " in said


def test_a_cart_that_dwells_at_its_largest_deflection_is_measured() -> None:
    """An overdamped cart that a square wave pushes to and fro comes to rest at one and the same count each time."""
    time = STEP * np.arange(4000)
    target = 0.01 * np.sign(np.sin(2.1 * time + 0.1))
    place, position = 0.0, np.zeros(len(time))
    for n, there in enumerate(target):
        place += (there - place) * STEP / 0.15
        position[n] = place
    dwelling = recording(np.round(position / 1e-5) * 1e-5)
    assert np.count_nonzero(position_of(dwelling) == np.max(position_of(dwelling))) > 200
    assert dwelling.mended()["run"] is dwelling["run"]


@pytest.mark.parametrize("kept", ["zero", "last"])
def test_a_dropout_becomes_missing(kept: str) -> None:
    values = swing()
    values[700:760] = 0.0 if kept == "zero" else values[699]
    found = np.flatnonzero(np.isnan(position_of(recording(values).mended())))
    assert (found[0], found[-1]) == (700 if kept == "zero" else 699, 759)
    assert len(found) == found[-1] - found[0] + 1


def test_spikes_become_missing_in_a_position_only() -> None:
    values = swing()
    values[[300, 801, 802]] += 5e-3
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(position_of(recording(values).mended()))), [300, 801, 802])
    speed = rtac.Experiment.of("run", kind="free", sample_time=STEP, cart="clamped", arm_velocity=1e3 * values)
    assert not np.isnan(rtac.Recording([speed]).mended()["run"].outputs["arm_velocity"].values).any()


@pytest.mark.parametrize("level", [1e-6, 6.25e-6])
def test_a_cart_that_friction_holds_and_lets_go_is_measured(level: float) -> None:
    """By an encoder: a decay comes to rest, and a force lets the cart hop to another place and rest again."""
    time = STEP * np.arange(2500)
    swinging, hop = (
        np.minimum(time, 1.25),
        np.clip((time - 2.0) / 0.03, 0.0, 1.0),
    )  # it comes to rest where it turns round
    moved = 0.01 * np.exp(-3.0 * swinging) * np.cos(4 * np.pi * swinging) + 300 * level * (1 - np.cos(np.pi * hop))
    held = recording(np.round(moved / level) * level)
    assert not any("drops out" in sentence for sentence in concerns(held))
    assert held.mended()["run"] is held["run"]


def test_a_stuck_cart_between_two_levels_is_not_at_the_end_of_a_range() -> None:
    """The largest value of few levels comes again and again, and is no end."""
    rng = np.random.default_rng(2)
    values = 6.25e-6 * np.repeat(rng.integers(0, 2, size=200), 10)
    assert not any("range of the sensor" in sentence for sentence in concerns(recording(values)))


def test_recordings_of_an_independent_rig_stay_as_they_are() -> None:
    for seed, hidden in enumerate(({}, {"end_stop_travel": 0.008, "end_stop_stiffness": 3e4}, {"backlash": 0.1})):
        rig = dataclasses.replace(virtual_rig.Rig(), **hidden)
        made = virtual_rig.record(rig, virtual_rig.standard_plans(seed=seed, duration=3.0, free=2, forced=2), seed=seed)
        assert made.mended().experiments == made.experiments


def write(path: Path, rows: np.ndarray) -> Path:
    path.write_text("t,x,F\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows))
    return path


def read(path: Path, **options: bool) -> rtac.Experiment:
    channels = {"cart_position": "x", "disturbance_force": "F"}
    return rtac.Recording.from_csv(path, channels=channels, kind="forced", time="t", arm="locked", **options)["run"]  # pyright: ignore[reportArgumentType]


def rows_of(samples: int = 400) -> np.ndarray:
    time = STEP * np.arange(samples)
    return np.stack([time, swing(samples), np.sign(np.sin(7 * time + 0.1))], axis=1)


def test_rows_that_are_lost_are_put_back_as_missing(tmp_path: Path) -> None:
    whole = rows_of()
    lost = [100, 101, 102, 333]
    path = write(tmp_path / "run.csv", np.delete(whole, lost, axis=0))
    with pytest.raises(RecordingError, match=r"index 100: the step is 0.008 s .* rows are missing there: .*--mend"):
        read(path)
    found = read(path, mend=True)
    assert (found.samples, found.sample_time) == (400, pytest.approx(STEP))
    position, force = found.outputs["cart_position"].values, found.inputs["disturbance_force"].values
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(position)), lost)
    kept = np.setdiff1d(np.arange(400), lost)
    np.testing.assert_allclose(position[kept], whole[kept, 1], rtol=1e-7)
    np.testing.assert_array_equal(force[kept], whole[kept, 2])
    np.testing.assert_array_equal(force[lost], whole[[99, 99, 99, 332], 2])


def test_a_measured_input_goes_straight_over_lost_rows(tmp_path: Path) -> None:
    whole = rows_of()
    whole[:, 2] = np.arange(len(whole))
    path = write(tmp_path / "run.csv", np.delete(whole, [100, 101], axis=0))
    channels = {"cart_position": "x", "disturbance_force": "F"}
    for between, expected in (("bl", [100.0, 101.0]), ("zoh", [99.0, 99.0])):
        found = rtac.Recording.from_csv(
            path, channels=channels, kind="forced", time="t", arm="locked", intersample=between, mend=True
        )["run"]
        np.testing.assert_allclose(found.inputs["disturbance_force"].values[100:102], expected)


@pytest.mark.parametrize(("rate", "digits"), [(960, 3), (980, 3), (995, 3), (97, 2), (333, 3)])
def test_times_that_are_rounded_lose_no_rows(rate: int, digits: int) -> None:
    """A clock that ticks a little slower than its times are written skips one of these at even distances."""
    assert places_of_rows(np.round(np.arange(1500) / rate, digits)) is None


def test_rows_are_lost_from_times_in_whole_milliseconds() -> None:
    times = 1e-3 * np.delete(np.arange(1500), [200, 201, 900, 1203])
    found = places_of_rows(times)
    assert found is not None
    np.testing.assert_array_equal(np.setdiff1d(np.arange(1500), found), [200, 201, 900, 1203])


def test_times_that_are_on_no_clock_are_refused_with_mend_too(tmp_path: Path) -> None:
    whole = rows_of()
    whole[200:, 0] += 0.4 * STEP
    with pytest.raises(RecordingError, match="bring the samples to one clock"):
        read(write(tmp_path / "run.csv", whole), mend=True)


@pytest.mark.parametrize(
    ("times", "places"),
    [
        ([0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0], [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11]),
        (list(range(11)), None),  # nothing is lost
        ([0.0, 1.0, 3.0, 5.0, 6.0], None),  # too many
        ([0.0, 1.0, 1.0, 3.0], None),  # no rising time
        ([0.0], None),
    ],
)
def test_places_of_rows(times: list[float], places: list[int] | None) -> None:
    found = places_of_rows(np.asarray(times, dtype=float))
    assert (None if found is None else found.tolist()) == places
