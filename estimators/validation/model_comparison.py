"""Comparison of fitted models: on experiments left out, and stretch of time by stretch of time."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from estimators.prediction_error.ekf import Filtered
from estimators.validation.vuong_test import by_stretch, vuong_statistic

_ROUNDING = 1e-15  # of what all say of an unknown
_NOTHING = 1e-9  # fraction of what all know of an effect below which no step can be taken without one experiment


def held_out(
    factor: Float[np.ndarray, "experiment row column"], shared: int, added: Sequence[int]
) -> tuple[Float[np.ndarray, " experiment"], Float[np.ndarray, " experiment"]]:
    """Return the change of each experiment's log-likelihood when an effect is estimated from the other experiments only.

    Returned beside it is the least fraction that these others know of what all experiments know of a combination of its parameters.

    The fit to the others is one Gauss-Newton step away from the fit to all, so no experiment is simulated again. The model's
    other parameters follow as they do in the fit to all: an experiment is seldom the only one that tells of the effect, but
    often the only one that tells of some parameter. Where the others know nothing of the effect the change is NaN.

    Args:
        factor: triangular factors of [J, r] of the whitened innovations at the fit to all; columns of the shared
            unknowns first, then those that every experiment has for itself.
        shared: number of shared unknowns.
        added: places among them of the effect's parameters.

    Source: Giordano and others, A Swiss Army infinitesimal jackknife (2019).
    """
    own = factor.shape[2] - 1 - shared
    order = np.concatenate([factor[:, :, shared:-1], factor[:, :, :shared], factor[:, :, -1:]], axis=2)
    # What an experiment has for itself it fits for itself, also when it is held out.
    rotated = np.asarray(np.linalg.qr(order, mode="r"))[:, own:, own:]
    # In units of what all experiments say of each unknown, which a scale that is far off makes too small or too large to square.
    norms = np.sqrt(np.sum(rotated[:, :, :-1] ** 2, axis=(0, 1)))
    rotated = np.concatenate([rotated[:, :, :-1] / np.where(norms > 0, norms, 1.0), rotated[:, :, -1:]], axis=2)
    normal = np.swapaxes(rotated, 1, 2) @ rotated
    hessian, slope = normal[:, :-1, :-1], normal[:, :-1, -1]
    whole = hessian.sum(axis=0)
    effect = np.asarray(added, dtype=int)
    others = np.setdiff1d(np.arange(shared), effect)
    follow = np.zeros((shared, len(effect)))
    follow[effect] = np.eye(len(effect))
    follow[others] = -np.linalg.lstsq(whole[others][:, others], whole[others][:, effect], rcond=1e-12)[0]
    curvature = follow.T @ hessian @ follow
    pull = slope @ follow
    total = curvature.sum(axis=0)
    size = np.sqrt(np.maximum(np.diagonal(total), _ROUNDING))
    change = np.full(len(factor), np.nan)
    known = np.zeros(len(factor))
    for e in range(len(factor)):
        rest = total - curvature[e]
        scaled = np.linalg.lstsq(total / np.outer(size, size), rest / np.outer(size, size), rcond=1e-12)[0]
        known[e] = np.min(np.linalg.eigvals(scaled).real)
        if not known[e] > _NOTHING:
            continue
        step = -np.linalg.solve(rest, pull.sum(axis=0) - pull[e])
        change[e] = -0.5 * float(step @ curvature[e] @ step + 2 * step @ pull[e])
    return change, known


def by_sample(filtered: Filtered) -> Float[np.ndarray, "sample experiment"]:
    """Return the log-likelihood of each sample given those before it, less a constant."""
    scale = np.diagonal(np.asarray(filtered.whitener), axis1=1, axis2=2)  # [sample experiment output]
    counts = scale > 0
    errors = np.swapaxes(np.asarray(filtered.innovations), 1, 2)
    return np.sum(np.where(counts, np.log(np.where(counts, scale, 1.0)) - 0.5 * errors**2, 0.0), axis=2)


def vuong(better: np.ndarray, other: np.ndarray, blocks: np.ndarray, price: float) -> float:
    """Return the standard normal statistic for the better of two models that need not contain each other.

    Args:
        better: log-likelihoods by sample of the better model.
        other: log-likelihoods by sample of the other model.
        blocks: number of the stretch of time that each sample belongs to.
        price: of the parameters that the better model has more, in log-likelihood.

    Source: Vuong, Econometrica 57 (1989), on sums over stretches of time.
    """
    return vuong_statistic(by_stretch(better, blocks).tolist(), by_stretch(other, blocks).tolist(), price)
