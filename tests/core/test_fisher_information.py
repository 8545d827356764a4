"""Covariance and identifiability from a whitened Jacobian."""

import numpy as np
import pytest

import estimators as est
from estimators.core.fisher_information import information_of


def test_information_names_what_is_free_and_matches_least_squares() -> None:
    random = np.random.default_rng(1)
    matrix = random.normal(size=(200, 2))
    known = information_of(matrix, ("a", "b"), np.array([1.0, 1.0]))
    np.testing.assert_allclose(known.covariance, np.linalg.inv(matrix.T @ matrix), rtol=1e-10)
    assert known.undetermined() == []
    together = information_of(matrix[:, :1] @ np.array([[1.0, -1.0]]), ("a", "b"), np.array([1.0, 1.0]))
    assert together.undetermined() == ["a, b may be scaled together"]
    silent = information_of(matrix * np.array([1.0, 0.0]), ("a", "b"), np.array([1.0, 1.0]))
    assert silent.undetermined() == ["b has no effect on what was measured"]
    with pytest.raises(est.NotIdentifiableError, match="b has no effect"):
        silent.require_determined()
