"""What of a recording is fitted, and in which pieces."""

import numpy as np
import pytest
from small_experiments import forced, free, rest

from estimators.core.data import fitted_part, origins, pieces
from rtac_jax.measurement import Experiment, Recording

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


def test_a_recording_of_which_nothing_was_fitted_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the fit used other, .*give the recording that was fitted"):
        fitted_part(RECORDING, ("other",))


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
