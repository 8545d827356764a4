"""Replication test: what comes back in every repeat of one experiment is not noise, whatever the colour of the noise."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter
from scipy.stats import f as fisher

from estimators.core.correlation import autocovariance
from estimators.misspecification.findings import RepeatTest
from rtac_jax.measurement import Experiment

_AVERAGE = 5  # samples of the moving average that leaves out what no mechanism follows


def repeat_test(innovations: np.ndarray, present: np.ndarray, experiments: Sequence[Experiment]) -> RepeatTest | None:
    """Test model error against noise from experiments that repeat each other (F test); None where none does.

    Args:
        innovations: [sample output experiment], of unit variance where the model is right.
        present: 1 where measured.
        experiments: in the order of the innovations.

    Source: Ljung, System Identification (1999), section 16.5, for model error against noise; degrees of freedom after
    Bartlett, Supplement to the Journal of the Royal Statistical Society 8 (1946).
    """
    groups: dict[tuple[str, float], list[int]] = {}
    for column, e in enumerate(experiments):
        groups.setdefault((e.repeat_of or e.name, e.sample_time), []).append(column)
    shared, between, above, below, members, seen, excess = 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0
    for columns in groups.values():
        m = len(columns)
        if m < 2:
            continue
        members += m
        for output in range(innovations.shape[1]):
            there = present[:, output, columns].all(axis=1)
            if there.sum() < 10 * _AVERAGE:
                continue
            seen += float(there.sum() * m)
            error = innovations[there][:, output, columns]
            noise = error.var(axis=1, ddof=1)
            if not noise.any():
                continue
            # Not smoothed: that would leave out what is fast, and count what is slow more than once.
            excess += float(np.sum(m * error.mean(axis=1) ** 2 - noise) / np.mean(noise))
            smooth = np.asarray(lfilter(np.full(_AVERAGE, 1 / _AVERAGE), [1.0], error, axis=0))[_AVERAGE:]
            mean = smooth.mean(axis=1)
            apart = smooth - mean[:, None]
            effective = _effective(apart)
            shared += m * float(np.mean(mean**2)) * effective
            between += float(np.mean(np.sum(apart**2, axis=1))) / (m - 1) * effective
            above += effective
            below += effective * (m - 1)
    if not members or between <= 0:
        return None
    ratio = shared / between
    p_value = float(fisher.sf(ratio, above, below))
    return RepeatTest(
        ratio, (above, below), p_value, (shared - between) / above, members, seen / float(present.sum()), excess
    )


def _effective(apart: np.ndarray) -> float:
    """Return the number of independent values that have as uncertain a mean square as these."""
    count = len(apart)
    own = np.sum([autocovariance(column, count // 2 - 1) for column in apart.T], axis=0)
    correlation = own / own[0]
    # Beyond the first lag where nothing is left the estimate is noise only.
    small = np.abs(correlation) < 2 / np.sqrt(count)
    last = int(np.argmax(small)) if small.any() else len(correlation)
    return count / (1.0 + 2.0 * float(np.sum(correlation[1:last] ** 2)))
