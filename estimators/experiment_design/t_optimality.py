"""T-optimality: separation of effects by experiments, as the change by one that another cannot imitate."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.data import CHANNELS, Data
from estimators.core.initial_state import space_of
from estimators.diagnosis.setting import absent_like
from estimators.experiment_design.hypotheses import MODEL, Contest
from estimators.prediction_error.ekf import filtered
from estimators.prediction_error.innovations import Innovations, Rows
from estimators.prediction_error.noise_model import start_variance
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment, Plan
from rtac_jax.parameters import declarations

_OWN = 6  # parameters that an effect may have
_STEPS = 3  # towards where an effect is nearest to another: a difference of 2 % is 1e-7 after two
_ROUNDING = 1e-10  # fraction of the largest eigenvalue below which a direction is rounding

Separation = dict[tuple[str, str], float]


def separations(
    contest: Contest, recorded: Sequence[Experiment], plans: Sequence[Plan], planned: Sequence[Experiment]
) -> tuple[Separation, list[Separation]]:
    """Return the separation of each pair by the recorded experiments alone, and together with each planned one.

    Everything is computed for all experiments at once, as products of columns that add up over experiments. What the
    second effect of a pair cannot imitate is linearised where that effect is at its estimate, nearer to the first than the
    model with neither, and with all parameters where they foretell what was recorded as the best model does: else what a straight
    line misses would tell apart what no motion does, as a sensor's gain from a wrong constant.
    """
    experiments = [*recorded, *planned]
    start = dict(contest.start) | {plan.name: np.array(plan.start) for plan in plans}
    innovations = _innovations(contest, experiments, start)
    space = innovations.space
    points = [(MODEL, np.asarray(space.values), np.zeros(0, dtype=int))]
    for name in contest.effects:
        for instance in contest.instances[name]:
            at = np.asarray(space.values).copy()
            for parameter in declarations(instance):
                at[space.names.index(f"{name}.{parameter}")] = float(np.asarray(getattr(instance, parameter)))
            free = [n for n, declared in declarations(instance).items() if not declared.fixed]
            points.append((name, at, np.array([space.names.index(f"{name}.{n}") for n in free])))
    best = next((n for n, (name, _, _) in enumerate(points) if name in contest.truth), None)
    if best is not None:
        # By what was recorded: a planned experiment in which friction holds or the arm tumbles would lead it astray.
        wanted = innovations.at(points[best][1][None])[:, 0]
        rows = len(wanted) * len(recorded) // len(experiments)
        points = [
            (name, _nearest(innovations, wanted[:rows], at, own), own)
            if n != best and len(contest.instances.get(name, ())) == 1
            else (name, at, own)
            for n, (name, at, own) in enumerate(points)
        ]
    errors = innovations.at(np.stack([at for _, at, _ in points]))
    by_rival = {}
    for number, (name, at, own) in enumerate(points):
        if any(j == name for _, j in contest.pairs):
            by_rival[number] = _products(innovations, errors - errors[:, [number]], at, own, len(experiments))
    before = {number: product[: len(recorded)].sum(axis=0) for number, product in by_rival.items()}

    def of(place: int | None) -> Separation:
        found = {}
        for i, j in contest.pairs:
            found[i, j] = min(
                _left(before[rival] + (0.0 if place is None else by_rival[rival][place]), number, len(points))
                for number, (name, _, _) in enumerate(points)
                for rival in by_rival
                if name == i and points[rival][0] == j
            )
        return found

    return of(None), [of(len(recorded) + place) for place in range(len(planned))]


def _products(
    innovations: Innovations, differences: Rows, at: np.ndarray, own: np.ndarray, experiments: int
) -> Float[np.ndarray, "experiment term term"]:
    """Return products of columns for each experiment.

    The columns are the differences, and the derivatives by base and own parameters at a point.
    """
    columns = np.concatenate([differences, _here(innovations, at, own).jacobian()], axis=1)
    split = columns.reshape(experiments, -1, columns.shape[1])
    return np.einsum("era,erb->eab", split, split, optimize=True)


def _here(innovations: Innovations, at: np.ndarray, own: np.ndarray) -> Innovations:
    """Return the innovations at a point, with the base and own parameters free."""
    space = innovations.space
    active = np.asarray(space.active).copy()
    active[-_OWN : len(active) - _OWN + len(own)] = own
    moved = dataclasses.replace(space, values=jnp.asarray(at), active=jnp.asarray(active))
    return Innovations(
        innovations.model, innovations.data, moved, innovations.whitener, innovations.gain, innovations.substeps
    )


def _nearest(innovations: Innovations, wanted: np.ndarray, at: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the point from which the first rows are nearest to those that are wanted, by Gauss-Newton steps while they serve."""
    space = innovations.space
    lower, upper, scale = (np.asarray(x) for x in (space.lower, space.upper, space.scale))
    rows = len(wanted)
    apart = wanted - innovations.at(at[None])[:rows, 0]
    for _ in range(_STEPS):
        here = _here(innovations, at, own)
        free = np.array([place for place in np.asarray(here.space.active) if place < len(at)])
        columns = here.jacobian()[:rows, np.flatnonzero(np.asarray(here.space.active) < len(at))]
        if not np.all(np.isfinite(columns)):
            break
        further = at.copy()
        further[free] += scale[free] * np.linalg.lstsq(columns, apart, rcond=_ROUNDING)[0]
        further = np.clip(further, lower, upper)
        left = wanted - innovations.at(further[None])[:rows, 0]
        if not np.sum(left**2) < np.sum(apart**2):
            break
        at, apart = further, left
    return at


def _left(product: Float[np.ndarray, "term term"], number: int, first: int) -> float:
    """Return the square of what is left of one column when those from `first` on have been projected out of it."""
    here = np.array([number, *range(first, len(product))])
    part = product[here][:, here]
    if not np.all(np.isfinite(part)):
        return 0.0  # a predictor that breaks down tells nothing
    size = np.sqrt(np.diagonal(part)[1:])
    sound = size > 0
    scaled = part[1:, 1:][sound][:, sound] / np.outer(size[sound], size[sound])
    overlap = part[0, 1:][sound] / size[sound]
    weights, directions = np.linalg.eigh(scaled)
    keep = weights > _ROUNDING * np.max(weights, initial=0.0)
    explained = float(np.sum((directions[:, keep].T @ overlap) ** 2 / weights[keep]))
    return max(float(part[0, 0]) - explained, 0.0)


def _innovations(contest: Contest, experiments: Sequence[Experiment], start: Mapping[str, np.ndarray]) -> Innovations:
    """Return the innovations of the base model's predictor, with all effects in it at null."""
    data = Data.of(experiments)
    free = [name for name in contest.base.free if name not in contest.base.per_experiment]
    space = space_of(contest.base, experiments, free=free, start=start)
    substeps = jnp.asarray(contest.substeps)
    passed = filtered(
        contest.base, data, space, space.physical(space.unconstrained(start=False)),
        sensor_variance=jnp.broadcast_to(contest.sensor_variance[:, None], (len(CHANNELS), data.experiments)),
        process=(jnp.asarray(contest.process[0]), jnp.asarray(contest.process[1])),
        start_variance=start_variance(space),
        substeps=substeps,
    )  # fmt: skip
    absent: list[Effect] = [absent_like(contest.instances[name][0]) for name in contest.effects]
    model = reduce(RTAC.__add__, absent, contest.base)
    wide = space_of(model, experiments, free=free, start=start)
    active = np.full(len(free) + _OWN, len(wide.names))
    active[: len(free)] = [wide.names.index(name) for name in free]
    # Of constants that were measured, whatever their errors could change is projected out, however small these are.
    wide = dataclasses.replace(wide, active=jnp.asarray(active), known=None, known_std=None)
    # A state that the filter does not know is not corrected.
    rows = {name: passed.gain[:, place] for place, name in enumerate(contest.base.states)}
    nothing = jnp.zeros_like(passed.gain[:, 0])
    gain = jnp.stack([rows.get(name, nothing) for name in model.states], axis=1)
    sure = 1.0 - passed.shaken[:, None, None]  # as in the diagnosis that is to tell them apart
    return Innovations(model, data, wide, passed.whitener * sure, gain, substeps)
