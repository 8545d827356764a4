"""Where a linear fit begins."""

import numpy as np
import pytest

from estimators.linear.initialisation import _columns, _explained


@pytest.mark.parametrize("known", [0, 1, 3])
def test_what_a_pair_of_poles_explains_is_that_of_least_squares(known: int) -> None:
    """Sums over lines instead of columns: held against least squares with the columns themselves."""
    random = np.random.default_rng(known)
    omega = np.sort(random.uniform(1.0, 60.0, 80))
    into, target = (random.standard_normal(80) + 1j * random.standard_normal(80) for _ in range(2))
    pairs = np.stack([random.uniform(5.0, 50.0, 12) ** 2, random.uniform(0.5, 20.0, 12)], axis=1)
    beside = random.standard_normal((known, 80)) + 1j * random.standard_normal((known, 80))

    def split(lines: np.ndarray) -> np.ndarray:
        return np.concatenate([lines.real, lines.imag], axis=-1)

    def left(columns: np.ndarray) -> float:
        if len(columns) == 0:
            return float(np.sum(np.abs(target) ** 2))
        return float(np.linalg.lstsq(split(columns).T, split(target), rcond=None)[1][0])

    found = _explained(pairs, omega, into, target, beside if known else None)
    expected = [left(beside) - left(np.concatenate([beside, own])) for own in _columns(pairs, omega, into)]
    assert found == pytest.approx(expected, rel=1e-6)
