"""What of a recording is fitted, and in which pieces."""

import numpy as np
import pytest
from small_experiments import forced, free, rest

import estimators as est
from estimators.core.data import fitted_part, origins, pieces
from estimators.core.linearisation import at_fit
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording, RecordingError

RECORDING = Recording((free(), forced(), rest()), {"total_mass": 1.23})


def test_rest_records_stay_with_what_was_fitted() -> None:
    assert fitted_part(RECORDING, ("free",)).names == ("free", "rest")
    assert fitted_part(RECORDING, ("free", "forced")) is RECORDING


def test_an_experiment_that_was_fitted_in_pieces_counts_as_fitted() -> None:
    time = 1e-3 * np.arange(10_000)
    long = Experiment.of("long", kind="free", sample_time=1e-3, arm="locked", cart_position=np.cos(time))
    names = tuple(piece.name for piece in pieces([long]))
    assert len(names) > 1
    assert fitted_part(Recording((long, free())), names).names == ("long",)


def test_beside_a_long_experiment_others_are_cut_too_and_found_again() -> None:
    """All are simulated for as long as the longest. Beside pieces of 512 samples one of 8,000 takes sixteen times as long."""

    def locked(name: str, samples: int) -> Experiment:
        position = np.cos(1e-3 * np.arange(samples))
        return Experiment.of(name, kind="free", sample_time=1e-3, arm="locked", cart_position=position)

    long, middle, short = locked("long", 20_000), locked("middle", 8000), locked("short", 1000)
    assert pieces([middle, short]) == [middle, short]
    cut = pieces([long, middle, short])
    assert max(piece.samples for piece in cut) == 1000
    assert sum(piece.samples for piece in cut) == 29_000
    assert set(origins([long, middle, short]).values()) == {"long", "middle", "short"}
    assert list(origins([long, middle, short])) == [piece.name for piece in cut]
    # Whether it was fitted beside the long one or by itself.
    for beside in ([long, middle], [middle]):
        names = [piece.name for piece in pieces(beside) if piece.name.startswith("middle")]
        assert fitted_part(Recording((long, middle, short)), names).names == ("middle",)


def test_a_recording_of_which_nothing_was_fitted_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the fit used other, .*give the recording that was fitted"):
        fitted_part(RECORDING, ("other",))


@pytest.mark.parametrize(("gap", "without", "longest"), [("cart_position", 5, 500), ("arm_angle", 0, 3000)])
def test_a_sensor_that_fails_for_a_while_is_left_out_of_the_pieces_or_these_go_on(gap, without, longest) -> None:
    """An experiment whose sensor measured nothing in a whole piece was refused."""
    time = 0.002 * np.arange(9000)
    outputs = {"cart_position": np.cos(3 * time), "arm_angle": np.sin(time)}
    outputs[gap][3000:5500] = np.nan
    found = pieces([Experiment.of("e", kind="free", sample_time=0.002, initial_arm_angle=0.0, **outputs)])
    assert sum(piece.samples for piece in found) == 9000
    assert sum(gap not in piece.outputs for piece in found) == without
    assert all("arm_angle" in piece.outputs for piece in found)
    assert 500 <= max(piece.samples for piece in found) <= longest
    outputs[gap][3000:5500] = 0.01 * time[3000:5500]
    outputs[gap][5000:] = np.nan
    late = {
        channel: values[::-1] for channel, values in outputs.items()
    }  # nothing at the end, and nothing at the beginning
    for given in (outputs, late):
        found = pieces([Experiment.of("e", kind="free", sample_time=0.002, **given)])
        assert all("arm_angle" in piece.outputs for piece in found)
        assert sum(piece.samples for piece in found) == 9000
    locked = {"cart_position": given["cart_position"]}
    found = pieces([Experiment.of("l", kind="free", sample_time=0.002, arm="locked", **locked)])
    assert found[-1].name.endswith(":9000]")


def test_a_rig_that_rests_for_a_while_and_is_not_driven_is_no_fault_of_a_piece() -> None:
    """What coarse encoders show of it is one value; by itself such a record would be refused."""
    time = 0.002 * np.arange(9000)
    current = np.where(time < 8, np.sin(5 * time), 0.0)
    position, angle = (np.where(time < 8, np.round(x, 2), 0.5) for x in (np.cos(3 * time), np.sin(time)))
    long = Experiment.of(
        "e", kind="forced", sample_time=0.002, current=current, cart_position=position, arm_angle=angle
    )
    found = pieces([long])
    assert np.ptp(found[-1].outputs["cart_position"].values) == np.ptp(found[-1].outputs["arm_angle"].values) == 0
    assert sum(piece.samples for piece in found) == 9000
    assert found[0].part
    assert not long.part
    assert not long.cut(0, long.samples).part
    assert found[-1].cut(0, found[-1].samples).part  # and still a part of the long one
    with pytest.raises(RecordingError, match="the sensor was not connected or nothing moved"):
        Experiment.of("e", kind="free", sample_time=0.002, cart_position=position[-500:], arm_angle=angle[-500:])


def test_pieces_begin_where_a_sensor_comes_on() -> None:
    """Where outputs show where the rig is; an arm that only a tachometer shows has its angle from before."""
    place = np.arange(9500)
    late = np.where(place < 300, np.nan, np.cos(0.01 * place))
    later = np.where(place < 700, np.nan, np.sin(0.02 * place))
    encoder = Experiment.of(
        "e", kind="free", sample_time=0.01, cart_position=late, arm_angle=later, initial_arm_angle=0.1
    )
    first, *_, last = pieces([encoder])
    assert (first.name[:5], last.name[-6:]) == ("e[300", ":9500]")
    assert first.initial_arm_angle is None
    assert sum(piece.samples for piece in pieces([encoder])) == 9200
    assert set(origins([encoder]).values()) == {"e"}
    short = encoder.cut(0, 2000, "s")
    assert [(piece.name, piece.samples) for piece in pieces([short])] == [("s[300:2000]", 1700)]
    tachometer = Experiment.of(
        "t", kind="free", sample_time=0.01, cart_position=late, arm_velocity=later, initial_arm_angle=0.1
    )
    assert pieces([tachometer])[0] is tachometer
    assert len(pieces([tachometer])) == 1


def test_a_fit_finds_its_experiments_beside_a_longer_one() -> None:
    """Beside one that is cut a run of 1,100 samples would be cut as well, and the fit knows it whole."""

    def swinging(name: str, samples: int) -> Experiment:
        position = 0.01 * np.cos(0.1 * np.arange(samples)) * np.exp(-2e-3 * np.arange(samples))
        return Experiment.of(name, kind="free", sample_time=0.01, arm="locked", cart_position=position)

    long, short = swinging("long", 8300), swinging("short", 1100)
    assert len(pieces([long, short])[-1].name) > len("short")
    rig = {"total_mass": 1.5}
    fit = est.output_error(RTAC.from_rig(Recording((short,), rig)), Recording((short,), rig), progress=False)
    problem = at_fit(fit, Recording((long, short), rig))
    assert [e.name for e in problem.experiments] == ["short"]
