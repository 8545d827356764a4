"""Covariance and identifiability from a whitened Jacobian."""

import numpy as np
import pytest

import estimators as est
from estimators.core.fisher_information import Information, information_of
from estimators.core.results import NotIdentifiableError


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


@pytest.mark.parametrize(
    ("names", "free", "unseen"),
    [
        (("k", "a.x", "a.y"), [[0, 1, 0], [0, 0, 1]], ("a.x", "a.y")),
        (("k", "a.x", "a.y"), [[0, 0.6, 0.8], [0, -0.8, 0.6]], ("a.x", "a.y")),  # the same null space, turned
        (("k", "a.x", "a.y"), [[0, 0.6, 0.8]], ()),  # one may be traded against the other
        (("k", "a.x", "a.y"), [[1, 0, 0]], ()),  # no effect's
        (("a.x",), [[1]], ()),  # nothing is left
    ],
)
def test_parameters_that_show_nowhere_are_named_however_their_null_space_is_turned(names, free, unseen):
    free = np.array(free, dtype=float)
    rest = np.linalg.svd(free)[2][len(free) :]
    deviations = np.array([1e100] * len(free) + [0.01] * len(rest))
    found = Information(names, np.eye(len(names)), np.concatenate([free, rest]), deviations)
    with pytest.raises(NotIdentifiableError) as refused:
        found.require_determined()
    assert refused.value.unseen == unseen
