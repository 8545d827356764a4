"""How well experiments would tell effects apart: what one changes in the innovations and another cannot imitate."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators._contest import MODEL, Contest
from estimators._innovations import Innovations
from estimators._kalman import filtered
from estimators._menu import start_of
from estimators._problem import CHANNELS, Data
from estimators._search import _absent_like, _with_all
from estimators._start import space_of
from rtac_jax._parameter import declarations
from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment
from rtac_jax.virtual_rig import Plan

_ROUNDING = 1e-10  # share of the largest eigenvalue below which a direction is rounding

Separation = dict[tuple[str, str], float]


def separations(
    contest: Contest, recorded: Sequence[Experiment], plans: Sequence[Plan], planned: Sequence[Experiment]
) -> tuple[Separation, list[Separation]]:
    """Separation of each pair by what was recorded alone, and together with each planned experiment.

    Everything is computed for all experiments at once, as products of columns that add up over experiments.
    """
    experiments = [*recorded, *planned]
    start = dict(contest.start) | {plan.name: np.array(start_of(plan)) for plan in plans}
    innovations = _innovations(contest, experiments, start)
    space = innovations.space
    values = np.asarray(space.values)
    points: list[np.ndarray] = []
    own: list[tuple[str, np.ndarray, list[int]]] = []
    for name in contest.effects:
        for instance in contest.instances[name]:
            at = values.copy()
            for parameter in declarations(instance):
                at[space.names.index(f"{name}.{parameter}")] = float(np.asarray(getattr(instance, parameter)))
            free = [n for n, declared in declarations(instance).items() if not declared.fixed]
            own.append((name, at, [space.names.index(f"{name}.{n}") for n in free]))
            points.append(at)
    changes = innovations.at(np.stack([values, *points]))
    templates = changes[:, 1:] - changes[:, :1]
    base = innovations.jacobian()
    slopes = []
    for _, at, free in own:
        active = np.full(len(np.asarray(space.active)), len(space.names))
        active[: len(free)] = free
        moved = dataclasses.replace(space, values=jnp.asarray(at), active=jnp.asarray(active))
        at_instance = Innovations(
            innovations.model, innovations.data, moved, innovations.whitener, innovations.gain, innovations.substeps
        )
        slopes.append(at_instance.jacobian()[:, : len(free)])
    columns = np.concatenate([templates, base, *slopes], axis=1)
    split = columns.reshape(-1, len(experiments), columns.shape[1])
    products = np.einsum("rea,reb->eab", split, split, optimize=True)
    edges = np.cumsum([len(own) + base.shape[1], *(s.shape[1] for s in slopes)])
    nuisance = list(range(len(own), len(own) + base.shape[1]))
    before = products[: len(recorded)].sum(axis=0)

    def of(product: Float[np.ndarray, "column column"]) -> Separation:
        found = {}
        for i, j in contest.pairs:
            mine = [number for number, (name, _, _) in enumerate(own) if name == i]
            rival = [number for number, (name, _, _) in enumerate(own) if name == j]
            imitated = [[number, *range(edges[number], edges[number + 1])] for number in rival]
            options = [nuisance + extra for extra in imitated] if j != MODEL else [nuisance]
            found[i, j] = min(_left(product, number, option) for number in mine for option in options)
        return found

    return of(before), [of(before + product) for product in products[len(recorded) :]]


def _left(product: Float[np.ndarray, "column column"], number: int, others: Sequence[int]) -> float:
    """Square of what is left of one column when the others have been projected out of it."""
    here = np.array([number, *others])
    part = product[np.ix_(here, here)]
    if not np.all(np.isfinite(part)):
        return 0.0  # a predictor that breaks down tells nothing
    size = np.sqrt(np.diagonal(part)[1:])
    sound = size > 0
    scaled = part[1:, 1:][np.ix_(sound, sound)] / np.outer(size[sound], size[sound])
    overlap = part[0, 1:][sound] / size[sound]
    weights, directions = np.linalg.eigh(scaled)
    keep = weights > _ROUNDING * np.max(weights, initial=0.0)
    explained = float(np.sum((directions[:, keep].T @ overlap) ** 2 / weights[keep]))
    return max(float(part[0, 0]) - explained, 0.0)


def _innovations(contest: Contest, experiments: Sequence[Experiment], start: Mapping[str, np.ndarray]) -> Innovations:
    """Innovations of the base model's predictor, with all effects in it at null."""
    data = Data.of(experiments)
    free = [name for name in contest.base.free if name not in contest.base.per_experiment]
    space = space_of(contest.base, experiments, free=free, start=start)
    substeps = jnp.asarray(contest.substeps)
    passed = filtered(
        contest.base, data, space, space.physical(space.unconstrained(start=False)),
        sensor_variance=jnp.broadcast_to(contest.sensor_variance[:, None], (len(CHANNELS), data.experiments)),
        process=(jnp.asarray(contest.process[0]), jnp.asarray(contest.process[1])),
        start_variance=(space.start_scale * (1 - space.start_held)) ** 2,
        substeps=substeps,
    )  # fmt: skip
    absent: list[Effect] = [_absent_like(contest.instances[name][0]) for name in contest.effects]
    model = _with_all(contest.base, absent)
    wide = space_of(model, experiments, free=free, start=start)
    most = max(len(free), *(len(declarations(effect)) for effect in absent))
    active = np.full(most, len(wide.names))
    active[: len(free)] = [wide.names.index(name) for name in free]
    wide = dataclasses.replace(wide, active=jnp.asarray(active))
    # A state that the filter does not know is not corrected.
    rows = {name: passed.gain[:, place] for place, name in enumerate(contest.base.states)}
    nothing = jnp.zeros_like(passed.gain[:, 0])
    gain = jnp.stack([rows.get(name, nothing) for name in model.states], axis=1)
    return Innovations(model, data, wide, passed.whitener, gain, substeps)
