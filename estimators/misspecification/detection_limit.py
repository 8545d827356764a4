"""Detection limits: the size at which a candidate rejects by itself, where its change is not in proportion to its size."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimators.core.threads import at_once
from estimators.misspecification.candidate_screening import Group, Screened
from estimators.prediction_error.innovations import AT_ONCE, Rows, orthonormal
from rtac_jax.effects import Effect
from rtac_jax.parameters import declarations

_NEAR = 1.5  # of the chi-square at the limit, to either side, within which proportion holds
_LEAST = 1e-3  # of the limit by proportion, the smallest size that is looked at
_ROUNDS = 2


def is_testable(s: Screened, limit: float, most: float) -> bool:
    """Return whether the data could show a candidate, from its detection limit, below `most` times its plausible size."""
    return bool(np.isfinite(limit) and limit < most * abs(_plausible(s)))


def may_show(s: Screened, limit: float, most: float) -> bool:
    """Return whether a candidate may be as large as its detection limit: testable, or gross however little is plausible."""
    return bool(np.isfinite(limit) and limit < largest_size(s.instance, main_amplitude(s), most))


def largest_size(instance: Effect, amplitude: str, most: float) -> float:
    """Return the largest size that an effect may have: `most` times its plausible one, or more where its declaration says so."""
    plausible = abs(float(np.asarray(getattr(instance, amplitude))))
    return max(most * plausible, declarations(instance)[amplitude].largest)


def main_amplitude(s: Screened) -> str:
    """Return the amplitude whose limit is stated: the first, or one of the same unit that shows sooner."""
    declared = declarations(s.instance)
    alike = [i for i, name in enumerate(s.amplitudes) if declared[name].unit == declared[s.amplitudes[0]].unit]
    return s.amplitudes[min(alike, key=lambda i: float(s.limit[i]))]


def detection_limits(group: Group, several: Sequence[Screened], basis: Rows, most: float) -> dict[str, float]:
    """Return for every candidate the size of its main amplitude at which screening would reject.

    A template of a plausible size says so by proportion. At that limit the innovations are computed once more, and where the
    template explains more or less of their change, the size is looked for. Infinite where no size up to the largest
    (`largest_size`) is enough.
    """
    found = {s.id: limit if (limit := _by_proportion(s)) < _largest(s, most) else np.inf for s in several}
    sound = [s for s in several if np.isfinite(found[s.id])]
    shown = _scores(group, basis, sound, [found[s.id] for s in sound])
    off = [(s, not there >= _alarm(s)) for s, there in zip(sound, shown, strict=True) if not _as_expected(s, there)]
    looked_for = at_once(lambda one: _looked_for(group, basis, one[0], most if one[1] else None), off)
    return found | {s.id: limit for (s, _), limit in zip(off, looked_for, strict=True)}


def _as_expected(s: Screened, there: float) -> bool:
    """Return whether the limit by proportion predicts the statistic at that size."""
    return bool(_alarm(s) / _NEAR < there < _alarm(s) * _NEAR)


def _by_proportion(s: Screened) -> float:
    return float(s.limit[s.amplitudes.index(main_amplitude(s))])


def _largest(s: Screened, most: float) -> float:
    """Return the largest size that is looked at: beyond its bounds no estimate may go."""
    low, high = declarations(s.instance)[main_amplitude(s)].bounds
    return min(largest_size(s.instance, main_amplitude(s), most), high if _plausible(s) > 0 else -low)


def _alarm(s: Screened) -> float:
    """Return the chi-square of the change at the limit by proportion."""
    place = s.amplitudes.index(main_amplitude(s))
    return float((s.limit[place] * np.linalg.norm(s.templates[:, place])) ** 2)


def _plausible(s: Screened) -> float:
    return float(np.asarray(getattr(s.instance, main_amplitude(s))))


def _scores(group: Group, basis: Rows, several: Sequence[Screened], sizes: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the chi-square of each candidate at a size: of its change, the part that its templates explain."""
    if not several:
        return np.zeros(0)
    names = [main_amplitude(s) for s in several]
    instances = [
        replace(s.instance, **{name: float(np.sign(_plausible(s)) * size)})
        for s, name, size in zip(several, names, sizes, strict=True)
    ]
    columns = group.changes(instances, names)
    columns -= basis @ (basis.T @ columns)
    return np.array([_explained(s, column) for s, column in zip(several, columns.T, strict=True)])


def _explained(s: Screened, change: np.ndarray) -> float:
    """Return the explained chi-square; zero if the estimate has the wrong sign, infinite if the model diverges."""
    if not np.all(np.isfinite(change)):
        return np.inf
    along = float(s.templates[:, s.amplitudes.index(main_amplitude(s))] @ change) * _plausible(s)
    return float(np.sum((orthonormal(s.templates).T @ change) ** 2)) if along > 0 else 0.0


def _looked_for(group: Group, basis: Rows, s: Screened, most: float | None) -> float:
    """Search the smallest size on finer and finer grids that rejects, above the one by proportion; None: below it."""
    linear, alarm = _by_proportion(s), _alarm(s)
    low, high = (_LEAST * linear, linear) if most is None else (linear, _largest(s, most))
    if not low < high:
        return np.inf
    for _ in range(_ROUNDS):
        sizes = np.geomspace(low, high, AT_ONCE - 1)
        enough = np.flatnonzero(_scores(group, basis, [s] * len(sizes), sizes) >= alarm)
        if not len(enough):
            return np.inf
        first = int(enough[0])
        if first == 0:
            return float(sizes[0])
        low, high = float(sizes[first - 1]), float(sizes[first])
    return high
