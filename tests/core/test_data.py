"""Of a recording that holds more than was fitted, what was fitted is taken."""

import numpy as np
import pytest
from small_experiments import forced, free, rest

from estimators.core.data import fitted_part, pieces
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
