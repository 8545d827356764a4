"""Score test of whether innovations contain what some columns would add, by the model's variance and by the data's."""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2
from scipy.stats import f as fisher

from estimators.prediction_error.innovations import Rows

_SMALLEST = 1e-3  # singular values below this fraction of the largest belong to directions that the data do not show
_FEWEST = 2  # stretches that scatter


@dataclasses.dataclass(frozen=True)
class ScoreTest:
    """The result of `score_test`.

    Attributes:
        explained: twice the gain in log-likelihood.
        freedom: number of directions that the data show.
        p_value: the larger of two: by the model's variance, and by the scatter over stretches of time, which holds when the
            noise is coloured or heavier than the model thinks.
        coefficients: of the columns.
        std: their standard deviations; infinite where the data show nothing of a column.
        directions: combinations of the columns that the data show, most telling first.
        amounts: of each in `coefficients`.
        by_direction: what each of them explains.
    """

    explained: float
    freedom: int
    p_value: float
    coefficients: Float[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]
    directions: Float[np.ndarray, "direction column"]
    amounts: Float[np.ndarray, " direction"]
    by_direction: Float[np.ndarray, " direction"]

    @property
    def excess(self) -> float:
        """Return the explained part beyond what chance explains."""
        return self.explained - self.freedom


def score_test(
    columns: Rows, error: np.ndarray, basis: Float[np.ndarray, "row explained"], blocks: np.ndarray
) -> ScoreTest:
    """Test whether the error contains a combination of the columns.

    Args:
        columns: derivatives of the innovations.
        error: innovations, without their part in the basis.
        basis: orthonormal columns that the base model's parameters explain already.
        blocks: number of the stretch of time that each row belongs to; rows of one stretch are neighbours.

    Source: Wooldridge, Journal of Econometrics 47 (1991) for the robust form; Bell and McCaffrey, Survey Methodology 28
    (2002) for stretches against fits to the others; Hotelling's T-squared for few stretches.
    """
    size = np.linalg.norm(columns, axis=0)
    columns = columns - basis @ (basis.T @ columns)
    # The singular values, from the small product of the columns with themselves: those that count are far above rounding.
    squares, v = np.linalg.eigh(columns.T @ columns)
    s, vt = np.sqrt(np.maximum(squares[::-1], 0.0)), v.T[::-1]
    # What remains of a column that the base explains is rounding, not information.
    keep = (s > _SMALLEST * max(float(np.max(s, initial=0.0)), 1e-300)) & (s > 1e-7 * np.max(size, initial=1e-300))
    nothing = np.zeros(columns.shape[1])
    if not keep.any():
        return ScoreTest(0.0, 0, 1.0, nothing, nothing + np.inf, np.zeros((0, len(nothing))), np.zeros(0), np.zeros(0))
    directions = columns @ (vt[keep].T / s[keep])
    score = directions.T @ error
    explained, freedom = float(score @ score), int(keep.sum())
    left = error - directions @ score
    # Each stretch against a fit to the others, or few stretches would look quieter than they are.
    edges = np.flatnonzero(np.diff(blocks)) + 1
    parts = list(zip(np.split(directions, edges), np.split(left, edges), strict=True))
    others = np.eye(freedom) - np.stack([d.T @ d for d, _ in parts])
    slopes = np.stack([d.T @ one for d, one in parts])
    by_block = np.linalg.pinv(others, rcond=1e-6, hermitian=True) @ slopes[:, :, None]
    scatter = np.einsum("bi,bj->ij", by_block[:, :, 0], by_block[:, :, 0])
    p_value = max(float(chi2.sf(explained, freedom)), _p_by_scatter(score, scatter, len(parts)))
    inverse = vt[keep].T / s[keep]
    telling = np.argsort(-(score**2))
    std = np.where(size > _SMALLEST * np.max(size), np.sqrt(np.sum(inverse**2, axis=1)), np.inf)
    return ScoreTest(
        explained, freedom, p_value, -inverse @ score, std, vt[keep][telling], (-score / s[keep])[telling],
        score[telling] ** 2,
    )  # fmt: skip


def _p_by_scatter(
    score: Float[np.ndarray, " direction"], scatter: Float[np.ndarray, "direction direction"], count: int
) -> float:
    """Return the p-value of a score by its scatter over so many stretches.

    One stretch does not scatter, and rejects nothing more. Where stretches are too few to tell how all directions
    scatter together, it is that of the largest of them one by one.
    """
    freedom = len(score)
    if count > freedom + 1:
        hotelling = float(score @ np.linalg.lstsq(scatter, score, rcond=1e-10)[0])
        return float(fisher.sf(hotelling * (count - freedom) / (count * freedom), freedom, count - freedom))
    if count < _FEWEST:
        return 0.0
    one_by_one = score**2 / np.maximum(np.diagonal(scatter), 1e-300)
    return min(1.0, freedom * float(fisher.sf(np.max(one_by_one) * (count - 1) / count, 1, count - 1)))
