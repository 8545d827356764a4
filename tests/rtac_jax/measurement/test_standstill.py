"""What is exactly zero while nothing moves yet, and a slide that travels far, are no faults."""

import numpy as np
import pytest

from rtac_jax.measurement import Experiment, Recording, concerns
from rtac_jax.measurement._momentary_faults import dropouts


def started(before: int, after: int, *, gap: int = 0, coasts: bool = True) -> Recording:
    """A motor that stands still, is driven, and stops; its velocity comes from an encoder."""
    number = np.arange(400)
    turning = (number >= before) & (number < 400 - after)
    speed = 30.0 * (1 - np.exp(-(number - before) / 4.0)) + 2.0 * np.sin(0.7 * number)
    if after and coasts:
        speed = np.where(number > 200, speed[200] * (300 - number) / 100, speed)
    velocity = np.where(turning, np.maximum(np.round(speed / 0.7) * 0.7, 0.0), 0.0)
    if gap:
        velocity[200 : 200 + gap] = 0.0
    one = Experiment.of(
        "run", kind="forced", sample_time=0.01, cart="clamped", initial_arm_angle=0.0, arm_velocity=velocity,
        current=np.where(turning, 1.0, 0.0),
    )  # fmt: skip
    return Recording((one,), {"arm_inertia": 1e-3})


@pytest.mark.parametrize(
    ("before", "after", "gap", "dropout"),
    [(100, 0, 0, False), (0, 100, 0, False), (100, 100, 0, False), (0, 0, 40, True)],
)
def test_a_motor_that_does_not_turn_yet_has_a_sensor(before: int, after: int, gap: int, dropout: bool) -> None:
    recording = started(before, after, gap=gap)
    said = [text for text in concerns(recording) if "drops out" in text]
    assert bool(said) is dropout
    missing = np.isnan(recording.mended()["run"].outputs["arm_velocity"].values)
    assert missing.any() == dropout
    if dropout:
        assert missing[200 : 200 + gap].all()


def test_a_sensor_that_reads_zero_at_once_to_the_end_drops_out() -> None:
    assert [text for text in concerns(started(0, 100, coasts=False)) if "drops out" in text]


@pytest.mark.parametrize(("unit", "doubted"), [(1.0, False), (1000.0, True)])
def test_a_slide_that_travels_far_is_not_in_millimetres(unit: float, doubted: bool) -> None:
    time = 0.005 * np.arange(330)
    position = 0.5 * time + 2e-4 * np.sin(2 * np.pi * 12 * time) + 1e-5 * np.random.default_rng(1).normal(size=330)
    one = Experiment.of(
        "run",
        kind="forced",
        sample_time=0.005,
        arm="locked",
        cart_position=unit * position,
        disturbance_force=np.ones(330),
    )
    said = [text for text in concerns(Recording((one,), {"total_mass": 1.0})) if "more than 10 g" in text]
    assert bool(said) is doubted


def sticking(*, frozen: bool) -> Recording:
    """An arm that slows down and sticks, by an encoder of degrees at uneven times; its sensor may fail on the way."""
    rows = np.cumsum(0.005 + 0.002 * np.random.default_rng(5).random(170))
    part = np.minimum(rows / 0.75, 1.0)
    angle = 900.0 * (part - part**2 / 2)
    if frozen:
        angle[70:110] = angle[70]
    clock = np.arange(rows[0], rows[-1], 0.005)
    counted = np.interp(clock, rows, np.round(angle))
    one = Experiment.of(
        "run", kind="forced", sample_time=0.005, cart="clamped", initial_arm_angle=0.0, arm_angle=np.radians(counted),
        current=np.ones(len(clock)),
    )  # fmt: skip
    return Recording((one,), {"arm_inertia": 1e-3})


@pytest.mark.parametrize("frozen", [False, True])
def test_an_arm_that_sticks_in_the_end_is_no_dropout(frozen: bool) -> None:
    """What sticks tells dry friction, and is not to be taken away."""
    recording = sticking(frozen=frozen)
    said = concerns(recording)
    assert any("drops out" in text for text in said) is frozen
    assert not [text for text in said if "jumps by" in text]
    assert np.isnan(recording.mended()["run"].outputs["arm_angle"].values).any() == frozen


@pytest.mark.parametrize("frozen", [False, True])
def test_an_encoder_that_rests_before_it_turns_is_no_dropout_though_its_counts_were_divided(frozen: bool) -> None:
    """A lifted arm in whole degrees, brought to another clock: it rests at zero, falls back, and comes to rest a count beside."""
    rows = 1e-3 * np.arange(1301)
    lifted = np.where(rows < 0.1, 0.0, 150.0 * np.sin(np.pi * np.clip((rows - 0.1) / 0.95, 0.0, 1.0)) ** 2)
    angle = np.where(rows < 1.1, lifted, np.where(rows < 1.16, 0.0, 1.0))
    if frozen:
        angle[400:460] = 0.0
    clock = np.arange(0.0, rows[-1], 1.4e-3)
    read = np.round(np.interp(clock, rows, np.round(angle)), 1)
    assert bool(dropouts("arm_angle", np.radians(read))) is frozen


@pytest.mark.parametrize(("zeros", "turning", "told"), [(0, 0.0, True), (20, 0.0, False), (0, 15.0, False)])
def test_a_step_that_is_on_from_the_first_sample_hides_a_delay(zeros: int, turning: float, told: bool) -> None:
    number = np.arange(200)
    since = np.maximum(number - zeros - 3, 0)
    velocity = turning + (30.0 - turning) * (1 - np.exp(-since / 20.0))
    one = Experiment.of(
        "step", kind="forced", sample_time=0.01, cart="clamped", initial_arm_angle=0.0, arm_velocity=velocity,
        current=np.where(number >= zeros, 1.0, 0.0),
    )  # fmt: skip
    said = [text for text in concerns(Recording((one,), {"arm_inertia": 1e-3})) if "on from its first sample" in text]
    assert bool(said) is told
    if told:
        assert "step: the current is on" in said[0]
        assert "put the zeros that came before it into the file" in said[0]


def late(waits: int, *, frozen: bool = False, changed: int = 300) -> Recording:
    """A motor with its current on from the first sample that turns late, by an encoder in hundredths of a degree; it flickers."""
    number = np.arange(300)
    since = 0.005 * np.maximum(number - waits, 0)
    turned = 800.0 * (since - 0.14 * (1 - np.exp(-since / 0.14))) + 0.3 * np.random.default_rng(3).random(300)
    count = 360.0 / 4096
    angle = np.round(np.round((10.0 + turned) / count) * count, 2)
    angle[8:50] = angle[8] if waits > 50 or frozen else angle[8:50]
    one = Experiment.of(
        "step", kind="forced", sample_time=0.005, cart="clamped", initial_arm_angle=0.0, arm_angle=np.radians(angle),
        current=np.where(number < changed, 1.0, 1.5),
    )  # fmt: skip
    return Recording((one,), {"arm_inertia": 1e-3})


@pytest.mark.parametrize(("waits", "changed", "told"), [(64, 300, True), (3, 300, False), (64, 40, False)])
def test_how_long_nothing_moves_with_the_current_on_is_told(waits: int, changed: int, told: bool) -> None:
    """Not where the current changes before: friction may have held it until then."""
    said = [text for text in concerns(late(waits, changed=changed)) if "came later than the current on record" in text]
    assert bool(said) is told
    if told:
        assert "nothing moves for 0.3" in said[0]
        assert "--start of rtac import" in said[0]


def test_what_stands_still_before_it_is_let_go_neither_drops_out_nor_has_outliers() -> None:
    said = " ".join(concerns(late(64)))
    assert "drops out" not in said
    assert "outlier" not in said
    assert [text for text in concerns(late(3, frozen=True)) if "drops out" in text]  # while it turns


@pytest.mark.parametrize(("step", "told"), [(5e-10, True), (1e-6, False), (1e-3, False)])
def test_times_in_another_unit_are_told(step: float, told: bool) -> None:
    swing = np.sin(0.1 * np.arange(400))
    one = Experiment.of("run", kind="free", sample_time=step, cart="clamped", arm_angle=swing)
    said = [text for text in concerns(Recording((one,), {"arm_inertia": 1e-3})) if "no rig is read at" in text]
    assert bool(said) is told


def test_a_logger_that_fails_in_the_end_drops_out() -> None:
    """Zeros, or one value, from full speed to the end."""
    turning = np.concatenate([0.05 * np.arange(1500), np.zeros(500)])
    swinging = np.concatenate([0.02 * np.exp(-1e-3 * np.arange(1700)) * np.cos(0.05 * np.arange(1700)), np.zeros(300)])
    assert dropouts("arm_angle", turning) == [(1500, 2000)]
    assert dropouts("cart_position", swinging) == [(1700, 2000)]
