"""Recordings as they might have come out too: every experiment gets its own measurements, also where it was fitted in pieces."""

from types import SimpleNamespace

import numpy as np
from small_experiments import DT, free

from estimators.core.data import CHANNELS, origins, pieces
from estimators.inference.bootstrap import Shuffled, measured_again
from rtac_jax.measurement import Experiment

LONG = Experiment.of("long[1]", kind="free", sample_time=DT, arm="locked", cart_position=np.cos(np.arange(9000) * DT))
EXPERIMENTS = [free("run[1]"), LONG, free("run[2]")]


def test_a_piece_is_of_the_experiment_that_it_was_cut_from() -> None:
    found = origins(EXPERIMENTS)
    assert list(found) == [e.name for e in pieces(EXPERIMENTS)]
    assert found["run[1]"] == "run[1]"
    assert found["run[2]"] == "run[2]"
    assert [name for name in found.values()].count("long[1]") == len(found) - 2 > 1


def test_experiments_with_brackets_in_their_names_are_measured_again() -> None:
    cut = pieces(EXPERIMENTS)
    values = np.full((max(e.samples for e in cut), len(CHANNELS), len(cut)), np.nan)
    for column, piece in enumerate(cut):
        values[: piece.samples, 0, column] = piece.outputs["cart_position"].values + 1.0
    source = Shuffled.__new__(Shuffled)  # of which nothing else is asked than what was fitted
    object.__setattr__(source, "problem", SimpleNamespace(experiments=tuple(cut)))
    found = measured_again(EXPERIMENTS, source, values)
    assert [e.name for e in found] == [e.name for e in EXPERIMENTS]
    for before, after in zip(EXPERIMENTS, found, strict=True):
        assert np.array_equal(after.outputs["cart_position"].values, before.outputs["cart_position"].values + 1.0)
