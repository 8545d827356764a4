"""Whoever gives a long experiment to a diagnosis is told beforehand how long that takes, and what is answered sooner."""

import numpy as np
import pytest

from estimators.cli.waiting import time_for
from rtac_jax.measurement import Experiment, Recording


def decays(samples: int) -> Recording:
    """Return two decays of so many samples."""
    return Recording(
        [
            Experiment.of(f"free_{n}", kind="free", sample_time=1e-3, cart_position=np.cos(0.01 * np.arange(samples)))
            for n in (1, 2)
        ]
    )


def test_a_long_one_is_announced(capsys: pytest.CaptureFixture[str]) -> None:
    assert time_for(decays(25_000), None) == 1200.0
    said = capsys.readouterr().err
    assert "25,000 samples" in said
    assert "some 5 minutes" in said
    assert "--end of rtac import" in said
    assert said.count("\n") == 1


def test_a_short_one_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert time_for(decays(2_000), None) == 400.0
    assert capsys.readouterr().err == ""


def test_who_says_how_long_is_given_that_and_who_says_nothing_of_time_no_end():
    assert time_for(decays(25_000), 60.0) == 60.0
    assert time_for(decays(2_000), 0.0) is None
