"""Named candidates held against innovations: what each would have changed, beyond what the base parameters explain."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import f as fisher

from estimators._innovations import AT_ONCE, Innovations, Rows, orthonormal
from estimators._score_test import score_test
from rtac_jax._parameter import declarations


@dataclasses.dataclass(frozen=True)
class Screened:
    """One candidate of one shape against the innovations.

    Attributes:
        id: of the effect.
        instance: the effect at a plausible size.
        amplitudes: its amplitude parameters.
        begin: values at which to begin to fit them.
        statistic: chi-square distributed when the effect is absent; zero where the sign is unphysical.
        p_value: by the model's variance or by the scatter over seconds of data, whichever is larger.
        limit: size of the amplitudes at which an effect alone would raise the alarm on average.
        templates: projected change of the innovations per unit of each amplitude.
    """

    id: str
    instance: Any
    amplitudes: tuple[str, ...]
    begin: Float[np.ndarray, " amplitude"]
    statistic: float
    p_value: float
    limit: Float[np.ndarray, " amplitude"]
    templates: Rows


ALARM = 20.0
CHANCE = 2e-3  # of an alarm by any of the candidates that are tried, if nothing is missing
_SIZES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.5)  # of the plausible amplitude, that are tried
_THRESHOLD = 0.1  # of what proportion would ask of the smallest size, below which there is a threshold
_TRIED = 3  # candidates whose size is looked for so


def screen(
    innovations: Innovations,
    raw: np.ndarray,
    basis: Rows,
    instances: Sequence[Any],
    place: Any,
) -> list[Screened]:
    """Hold instances of candidates against the innovations.

    Args:
        raw: innovations with all candidates at null.
        basis: orthonormal columns that the base model's parameters explain already.
        place: gives for an effect, a parameter of it and the instance's other parameters the vector of shared values
            with only this amplitude switched on.
    """
    points, owners = [], []
    for number, instance in enumerate(instances):
        for amplitude in type(instance).amplitudes():
            points.append(place(instance, amplitude))
            owners.append((number, amplitude))
    error = raw - basis @ (basis.T @ raw)
    blocks = innovations.blocks()
    found = []
    by_instance: dict[int, list[tuple[str, np.ndarray]]] = {}
    for first in range(0, len(points), AT_ONCE):
        columns = innovations.at(np.array(points[first : first + AT_ONCE])) - raw[:, None]
        sound = np.isfinite(columns).all(axis=0)  # a candidate at its plausible size may make the model diverge
        columns[:, sound] -= basis @ (basis.T @ columns[:, sound])
        for (number, amplitude), column in zip(owners[first : first + AT_ONCE], columns.T, strict=True):
            size = float(np.asarray(getattr(instances[number], amplitude)))
            by_instance.setdefault(number, []).append((amplitude, column / size))
    for number, parts in by_instance.items():
        names = tuple(name for name, _ in parts)
        templates = np.stack([column for _, column in parts], axis=1)
        found.append(_screened(instances[number], names, templates, error, basis, blocks, len(by_instance)))
    clear = [s for s in found if s.statistic >= ALARM and len(s.amplitudes) == 1 and s.begin[0] != 0]
    largest = sorted(clear, key=lambda s: -s.statistic)[:_TRIED]
    return [_sized(innovations, error, basis, place, s) if any(s is one for one in largest) else s for s in found]


def _sized(innovations: Innovations, error: np.ndarray, basis: Rows, place: Any, s: Screened) -> Screened:
    """For what has a threshold: begin at the size that leaves least, beyond what the base parameters explain.

    A drive that saturates changes nothing up to a size and is far from linear beyond. What changes in proportion at small
    sizes begins where that leads.
    """
    (name,) = s.amplitudes
    plausible = abs(float(np.asarray(getattr(s.instance, name))))
    linear = float(s.begin[0])
    sizes = np.array([linear, *(np.sign(linear) * plausible * share for share in _SIZES)])
    points = [place(dataclasses.replace(s.instance, **{name: float(size)}), name) for size in sizes]
    left = innovations.at(np.array(points))
    left = left - basis @ (basis.T @ left)
    least, whole = (np.linalg.norm(left[:, 1 + _SIZES.index(size)] - error) for size in (_SIZES[0], 1.0))
    if not least < _THRESHOLD * _SIZES[0] * whole:
        return s
    left = np.sum(left**2, axis=0)
    best = int(np.argmin(np.where(np.isfinite(left), left, np.inf)))
    return dataclasses.replace(s, begin=sizes[best : best + 1])


def _screened(
    instance: Any,
    names: tuple[str, ...],
    templates: Rows,
    error: np.ndarray,
    basis: Float[np.ndarray, "row explained"],
    blocks: np.ndarray,
    tried: int,
) -> Screened:
    declared = declarations(instance)
    if not np.all(np.isfinite(templates)):
        none = np.zeros(len(names))
        return Screened(instance.id, instance, names, none, 0.0, 1.0, none + np.inf, 0 * np.nan_to_num(templates))
    gram = templates.T @ templates
    size = np.sqrt(np.diagonal(gram))
    with np.errstate(divide="ignore"):
        limit = np.sqrt(_alarm(len(np.unique(blocks)), tried)) / size
    sound = size > 1e-12 / np.array([max(abs(float(np.asarray(getattr(instance, n)))), 1e-300) for n in names])
    estimate = np.zeros(len(names))
    if sound.any():
        part = templates[:, sound]
        estimate[sound] = -np.linalg.lstsq(part, error, rcond=1e-8)[0]
    for i, name in enumerate(names):
        low, high = declared[name].bounds
        if not low <= estimate[i] <= high:
            estimate[i] = 0.0
    explained = -templates @ estimate
    statistic = float(2 * explained @ error - explained @ explained)
    allowed = estimate != 0.0
    # By stretch of time, too: what coloured noise, or friction that is shaken loose, does to a score shows in its scatter.
    p_value = score_test(templates[:, allowed], error, basis, blocks).p_value if statistic > 0 else 1.0
    return Screened(instance.id, instance, names, estimate, max(statistic, 0.0), p_value, limit, templates)


def _alarm(stretches: int, tried: int) -> float:
    """Chi-square at which one amplitude raises the alarm: fewer stretches of time tell their scatter less well."""
    if stretches < 3:
        return ALARM
    least = float(fisher.isf(CHANCE / tried, 1, stretches - 1)) * stretches / (stretches - 1)
    return max(ALARM, least)


def correlations(screened: Mapping[str, Screened]) -> dict[str, dict[str, float]]:
    """Largest cosine between what each two candidates would change."""
    bases = {name: orthonormal(s.templates) for name, s in screened.items() if np.any(s.templates)}
    edges = np.cumsum([0, *(basis.shape[1] for basis in bases.values())])
    whole = np.concatenate(list(bases.values()), axis=1) if bases else np.zeros((0, 0))
    products = whole.T @ whole
    found: dict[str, dict[str, float]] = {name: {o: 0.0 for o in screened if o != name} for name in screened}
    for i, a in enumerate(bases):
        for j, b in enumerate(bases):
            if i < j:
                block = products[edges[i] : edges[i + 1], edges[j] : edges[j + 1]]
                value = float(np.linalg.norm(block, 2)) if block.size else 0.0
                found[a][b] = found[b][a] = value
    return found
