"""Screening of the candidate set: what each candidate would change in the innovations, beyond the base parameters."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from estimators.core.threads import at_once
from estimators.misspecification.findings import CriticalValues
from estimators.misspecification.score_test import score_test
from estimators.prediction_error.innovations import AT_ONCE, Innovations, Rows, orthonormal
from rtac_jax.effects import Effect
from rtac_jax.parameters import declarations


class NotNothingError(ValueError):
    """Candidates that change what the model predicts although they are at null, or make it diverge."""

    def __init__(self, ids: Sequence[str]) -> None:
        super().__init__(ids)
        self.ids = tuple(dict.fromkeys(ids))


def same(innovations: np.ndarray, others: np.ndarray) -> bool:
    """Return whether innovations are the same but for rounding."""
    return bool(np.linalg.norm(innovations - others) <= _ROUNDING * np.linalg.norm(others))


class Group(NamedTuple):
    """Candidates that are simulated together.

    A model that has all of them at null, their instances, and the innovations without them.
    """

    innovations: Innovations
    instances: Sequence[Effect]
    base: np.ndarray

    def switched_on(self, instances: Sequence[Effect], amplitudes: Sequence[str]) -> Rows:
        """Return innovations where of each instance one amplitude is switched on; one column each."""
        return self.innovations.at(np.array([*map(self._placed, instances, amplitudes)]))

    def changes(self, instances: Sequence[Effect], amplitudes: Sequence[str]) -> Rows:
        """Return the change of the innovations by switching on of each instance one amplitude; one column each.

        Raises:
            NotNothingError: the candidates change something although all of them are at null.
        """
        points = [np.asarray(self.innovations.space.values), *map(self._placed, instances, amplitudes)]
        found = self.innovations.at(np.array(points))
        # A predictor that diverges itself is no candidate's fault.
        if np.all(np.isfinite(self.base)) and not same(found[:, 0], self.base):
            raise NotNothingError([instance.id for instance in self.instances])
        return found[:, 1:] - found[:, :1]

    def _placed(self, instance: Effect, amplitude: str) -> np.ndarray:
        """Return shared values with this amplitude switched on and no other."""
        space = self.innovations.space
        values = np.asarray(space.values).copy()
        for name, declared in declarations(instance).items():
            if declared.null is None or name == amplitude:
                values[space.names.index(f"{instance.id}.{name}")] = float(np.asarray(getattr(instance, name)))
        return values


@dataclasses.dataclass(frozen=True)
class Screened:
    """The score of one candidate of one shape against the innovations.

    Attributes:
        id: of the effect.
        instance: the effect at a plausible size.
        amplitudes: its amplitude parameters.
        begin: values at which to begin to fit them.
        statistic: chi-square distributed when the effect is absent; zero where the sign is unphysical.
        p_value: by the model's variance or by the scatter over seconds of data, whichever is larger.
        limit: size of the amplitudes at which an effect alone would reject on average.
        templates: projected change of the innovations per unit of each amplitude, of a candidate's largest shape; of others no
            row is kept.
    """

    id: str
    instance: Effect
    amplitudes: tuple[str, ...]
    begin: Float[np.ndarray, " amplitude"]
    statistic: float
    p_value: float
    limit: Float[np.ndarray, " amplitude"]
    templates: Rows

    def without_templates(self) -> "Screened":
        """Return the score alone: of 90,000 samples, templates of all candidates and shapes take two hundred megabytes."""
        return dataclasses.replace(self, templates=np.zeros((0, self.templates.shape[1])))


_ROUNDING = 1e-2  # what the filter's own pass and a simulation with its gains differ by is far less
_SIZES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.5)  # of the plausible amplitude, that are tried
_THRESHOLD = 0.1  # of what proportion would ask of the smallest size, below which there is a threshold
_COLUMNS = 2 * AT_ONCE - 1  # that are simulated for a part, beside what the model says without any
_UNSTABLE = 1e6  # times all innovations: no effect that leaves a rig standing changes so much
_TRIED = 3  # candidates whose size is looked for so


def screen(
    groups: Sequence[Group], error: np.ndarray, basis: Rows, ready: Callable[[], None], critical: CriticalValues
) -> list[Screened]:
    """Score all candidates against the innovations.

    Args:
        groups: of the candidate set.
        error: innovations of the base model, without their part in the basis.
        basis: orthonormal columns that the base model's parameters explain already.
        ready: called before each group is simulated.
        critical: from which on a candidate rejects; its limit follows from it.
    """
    tried = sum(len(group.instances) for group in groups)

    def held(group: Group) -> list[Screened]:
        ready()
        scores: list[Screened] = []
        for part in _parts(group):
            try:
                columns = _each(part)
            except NotNothingError:
                raise NotNothingError([instance.id for instance in group.instances]) from None
            scores += _one_by_one(part, columns, error, basis, tried, critical)
        best = {id(s) for s in by_statistic(scores).values()}
        return [s if id(s) in best else s.without_templates() for s in scores]

    found = [s for part in at_once(held, groups) for s in part]
    clear = [s for s in found if s.statistic >= critical.alarm and len(s.amplitudes) == 1 and s.begin[0] != 0]
    clear = [s for s in clear if s.instance.looked_at == 1.0]  # of the others proportion holds where it was looked at
    largest = sorted(clear, key=lambda s: -s.statistic)[:_TRIED]
    owner = {instance.id: group for group in groups for instance in group.instances}
    sized = at_once(lambda s: _sized(owner[s.id], error, basis, s), largest)
    instead = {id(s): other for s, other in zip(largest, sized, strict=True)}
    return [instead.get(id(s), s) for s in found]


def by_statistic(screened: Sequence[Screened]) -> dict[str, Screened]:
    """Return the largest shape of every candidate, by id."""
    best: dict[str, Screened] = {}
    for s in screened:
        if s.id not in best or s.statistic > best[s.id].statistic:
            best[s.id] = s
    return best


def _parts(group: Group) -> list[Group]:
    """Cut a group into parts of few columns: those of all candidates side by side would take hundreds of megabytes."""
    parts: list[list[Effect]] = [[]]
    columns = 0
    for instance in group.instances:
        own = len(type(instance).amplitudes())
        if columns and columns + own > _COLUMNS:
            parts.append([])
            columns = 0
        parts[-1].append(instance)
        columns += own
    return [group._replace(instances=part) for part in parts]


def _each(group: Group) -> Rows:
    """Return the change by each amplitude of each instance of a group by itself, per unit."""
    owners = [(i, amplitude) for i in group.instances for amplitude in type(i).amplitudes()]
    sizes = [i.looked_at * float(np.asarray(getattr(i, amplitude))) for i, amplitude in owners]
    instances = [
        i if i.looked_at == 1.0 else dataclasses.replace(i, **{amplitude: size})
        for (i, amplitude), size in zip(owners, sizes, strict=True)
    ]
    return group.changes(instances, [amplitude for _, amplitude in owners]) / sizes


def _one_by_one(
    group: Group,
    columns: Rows,
    error: np.ndarray,
    basis: Float[np.ndarray, "row explained"],
    tried: int,
    critical: CriticalValues,
) -> list[Screened]:
    """Score each instance of a group by itself."""
    # A candidate at its plausible size may make the model diverge, or a filter whose gains do not know its states: what then
    # follows sensors fast makes a twist grow without bound, and says nothing of the effect.
    sound = np.isfinite(columns).all(axis=0)
    columns[:, ~sound] = 0.0
    sound &= np.linalg.norm(columns * _plausible(group), axis=0) < _UNSTABLE * np.linalg.norm(group.base)
    columns[:, ~sound] = 0.0
    columns -= basis @ (basis.T @ columns)
    columns[:, ~sound] = np.nan
    blocks = group.innovations.blocks()
    stretches = len(np.unique(blocks))
    edges = np.cumsum([0, *(len(type(i).amplitudes()) for i in group.instances)])

    def one(place: int) -> Screened:
        instance, templates = group.instances[place], columns[:, edges[place] : edges[place + 1]].copy()
        names = tuple(type(instance).amplitudes())
        return _screened(instance, names, templates, error, basis, blocks, critical.of_few(stretches, tried))

    return at_once(one, range(len(group.instances)))


def _plausible(group: Group) -> Float[np.ndarray, " column"]:
    """Return the plausible size of each amplitude of each instance."""
    owners = [(i, amplitude) for i in group.instances for amplitude in type(i).amplitudes()]
    return np.array([i.looked_at * abs(float(np.asarray(getattr(i, amplitude)))) for i, amplitude in owners])


def _sized(group: Group, error: np.ndarray, basis: Rows, s: Screened) -> Screened:
    """Return a candidate with a threshold at the size that leaves least, beyond what the base parameters explain.

    A drive that saturates changes nothing up to a size and is far from linear beyond. What changes in proportion at small
    sizes begins where that leads.
    """
    (name,) = s.amplitudes
    plausible = abs(float(np.asarray(getattr(s.instance, name))))
    linear = float(s.begin[0])
    sizes = np.array([linear, *(np.sign(linear) * plausible * fraction for fraction in _SIZES)])
    left = group.switched_on(
        [dataclasses.replace(s.instance, **{name: float(size)}) for size in sizes], [name] * len(sizes)
    )
    left = left - basis @ (basis.T @ left)
    least, whole = (np.linalg.norm(left[:, 1 + _SIZES.index(size)] - error) for size in (_SIZES[0], 1.0))
    if not least < _THRESHOLD * _SIZES[0] * whole:
        return s
    left = np.sum(left**2, axis=0)
    best = int(np.argmin(np.where(np.isfinite(left), left, np.inf)))
    return dataclasses.replace(s, begin=sizes[best : best + 1])


def _screened(
    instance: Effect,
    names: tuple[str, ...],
    templates: Rows,
    error: np.ndarray,
    basis: Float[np.ndarray, "row explained"],
    blocks: np.ndarray,
    alarm: float,
) -> Screened:
    declared = declarations(instance)
    if not np.all(np.isfinite(templates)):
        none = np.zeros(len(names))
        return Screened(instance.id, instance, names, none, 0.0, 1.0, none + np.inf, 0 * np.nan_to_num(templates))
    gram = templates.T @ templates
    size = np.sqrt(np.diagonal(gram))
    with np.errstate(divide="ignore"):
        limit = np.sqrt(alarm) / size
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


def correlations(screened: Mapping[str, Screened]) -> dict[str, dict[str, float]]:
    """Return the largest cosine between what each two candidates would change."""
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
