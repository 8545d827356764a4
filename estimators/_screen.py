"""Candidates held against innovations: what each would have changed, beyond what the base model's parameters explain."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators._problem import Data, Space, Unknowns, residual
from rtac_jax import RTAC
from rtac_jax._simulate import Steps
from rtac_jax.effects import Force, Motion, States

_AT_ONCE = 8
Rows = Float[np.ndarray, "row column"]


class Innovations:
    """Innovations of a predictor with frozen gains, as a function of parameter values; rows are whitened samples."""

    def __init__(self, model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, substeps: Steps):
        self.model, self.data, self.space = model, data, space
        self.whitener, self.gain, self.substeps = whitener, gain, substeps
        self.used = np.asarray(data.present).any(axis=(0, 2))
        self.weight = np.asarray(data.present)[:, self.used]

    def at(self, values: Float[np.ndarray, "point parameter"]) -> Rows:
        """Innovations for several sets of shared parameter values, one column each."""
        columns = []
        for first in range(0, len(values), _AT_ONCE):
            part = values[first : first + _AT_ONCE]
            padded = np.concatenate([part, np.repeat(part[-1:], _AT_ONCE - len(part), axis=0)])
            found = _innovations(
                self.model, self.data, self.space, self.whitener, self.gain, jnp.asarray(padded), self.substeps
            )
            columns.append(self._rows(np.asarray(found)[: len(part)]))
        return np.concatenate(columns, axis=1)

    def along(self, model: RTAC, directions: Any, placed: Any) -> Rows:
        """Derivatives of the innovations along directions of some leaves of a model; see `_derivatives`."""
        found = _derivatives(model, placed, directions, self.data, self.space, self.whitener, self.gain, self.substeps)
        return self._rows(np.asarray(found))

    def jacobian(self) -> Rows:
        """Derivatives by the free shared parameters, scaled."""
        # A free parameter past the end is none: its direction, and so its column, is zero.
        directions = np.eye(len(self.space.names) + 1)[np.asarray(self.space.active), :-1] * np.asarray(
            self.space.scale
        )
        found = _jacobian(
            self.model, self.data, self.space, self.whitener, self.gain, jnp.asarray(directions), self.substeps
        )
        return self._rows(np.asarray(found))

    def _rows(self, found: np.ndarray) -> Rows:
        return found[:, :, self.used].reshape(len(found), -1).T

    def blocks(self, seconds: float = 1.0) -> np.ndarray:
        """For every row the number of the stretch of time that it belongs to, within its experiment."""
        samples, outputs, count = self.data.samples, int(self.used.sum()), self.data.experiments
        interval = np.asarray(self.data.excitation.sample_time)
        stretch = np.floor(np.arange(samples)[:, None] * interval / seconds).astype(int)
        stretch = stretch + (stretch.max() + 1) * np.arange(count)
        return np.broadcast_to(stretch[:, None, :], (samples, outputs, count)).reshape(-1)


def _error(
    model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, values: Array, substeps: Steps
) -> Array:
    fixed = dataclasses.replace(space, values=values, active=jnp.zeros((0,), dtype=int))
    unknowns = Unknowns(jnp.zeros(0), _each(space), jnp.zeros((0, data.experiments)))
    return residual(model, data, fixed, unknowns, whitener, substeps=substeps, gain=gain)[0]


def _each(space: Space) -> Array:
    """Unconstrained values of the parameters of each experiment; empty for most models."""
    return jnp.asarray(space.unconstrained(start=False).each) if len(space.each) else jnp.zeros_like(space.each_values)


@eqx.filter_jit
def _innovations(
    model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, values: Array, substeps: Steps
) -> Array:
    return jax.vmap(lambda v: _error(model, data, space, whitener, gain, v, substeps))(values)


@eqx.filter_jit
def _jacobian(
    model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, directions: Array, substeps: Steps
) -> Array:
    def function(values: Array) -> Array:
        return _error(model, data, space, whitener, gain, values, substeps)

    return jax.vmap(lambda t: jax.jvp(function, (space.values,), (t,))[1])(directions)


KNOTS = 12
VARIABLES = ("cart_position", "cart_velocity", "arm_angle", "arm_velocity", "current")
PORTS = ("cart", "arm")


class Probe(Force):
    """An unknown force at one port as a piecewise linear function of one variable; for `jax.jvp` at zero only."""

    id: ClassVar[str] = "probe"
    equation: ClassVar[str] = "sum of hat functions"
    source: ClassVar[str] = "de Boor, A Practical Guide to Splines (1978), chapter 3"
    port: ClassVar[str] = "cart or arm"
    nature: ClassVar[str] = "source"

    heights: Float[Array, " knot"]
    on_cart: Array
    on_arm: Array
    variable: Float[Array, " variable"]
    first: Array
    spacing: Array

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        turns = motion.arm_angle / (2 * jnp.pi)
        within = 2 * jnp.pi * (turns - jnp.floor(turns + 0.5))
        options = (motion.cart_position, motion.cart_velocity, within, motion.arm_velocity, motion.current)
        at = (sum(w * x for w, x in zip(self.variable, options, strict=True)) - self.first) / self.spacing
        hats = jnp.maximum(0.0, 1.0 - jnp.abs(at - jnp.arange(KNOTS).reshape(-1, *[1] * jnp.ndim(at))))
        total = jnp.tensordot(self.heights, hats, 1)
        return self.on_cart * total, self.on_arm * total


@eqx.filter_jit
def _derivatives(
    model: RTAC,
    probe: Probe,
    directions: Array,
    data: Data,
    space: Space,
    whitener: Array,
    gain: Array,
    substeps: Steps,
) -> Array:
    """Derivatives of the innovations by the heights of a probe at zero."""

    def function(heights: Array) -> Array:
        probed = model + eqx.tree_at(lambda p: p.heights, probe, heights)
        return _error(probed, data, space, whitener, gain, space.values, substeps)

    zero = jnp.zeros(KNOTS)
    return jax.vmap(lambda t: jax.jvp(function, (zero,), (t,))[1])(directions)


@dataclasses.dataclass(frozen=True)
class ForceCurve:
    """What is missing at one port, as a function of one variable.

    Attributes:
        port: "cart" [N] or "arm" [N m].
        variable: of `VARIABLES`.
        score: how much of the innovations it explains beyond chance; negative for nothing.
        at: values of the variable.
        force: the missing force there.
        std: its standard deviation.
        explains: twice the gain in log-likelihood.
    """

    port: str
    variable: str
    score: float
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    std: Float[np.ndarray, " knot"]
    explains: float


def force_curves(
    innovations: Innovations, error: np.ndarray, basis: Rows, ranges: dict[str, tuple[float, float]]
) -> list[ForceCurve]:
    """Missing force at each port against each variable, with bands, best score first.

    Args:
        error: the innovations of the base model.
        basis: orthonormal columns that its parameters explain already.
        ranges: between which values each variable moves.
    """
    found = []
    count = int(np.sum(innovations.weight > 0))
    for place, port in enumerate(PORTS):
        for index, variable in enumerate(VARIABLES):
            low, high = ranges[variable]
            if not high > low:
                continue
            spacing = (high - low) / (KNOTS - 1)
            probe = Probe(
                jnp.zeros(KNOTS), jnp.asarray(1.0 - place), jnp.asarray(float(place)), jnp.eye(len(VARIABLES))[index],
                jnp.asarray(low), jnp.asarray(spacing),
            )  # fmt: skip
            columns = innovations.along(innovations.model, jnp.eye(KNOTS), probe)
            columns = columns - basis @ (basis.T @ columns)
            u, s, vt = np.linalg.svd(columns, full_matrices=False)
            keep = s > 1e-3 * max(s[0], 1e-300)
            if s[0] < 1e-9:
                continue
            explained = u[:, keep].T @ error
            inverse = vt[keep].T / s[keep]
            curve = -inverse @ explained
            # Directions that the base parameters explain, such as a slope, are not the data's to give.
            std = np.sqrt(np.sum(inverse**2, axis=1))
            gain = float(explained @ explained)
            found.append(
                ForceCurve(
                    port,
                    variable,
                    gain - keep.sum() * np.log(count),
                    low + spacing * np.arange(KNOTS),
                    curve,
                    std,
                    gain,
                )
            )
    return sorted(found, key=lambda curve: -curve.score)


def orthonormal(columns: Rows) -> Float[np.ndarray, "row basis"]:
    """An orthonormal basis of what the columns span."""
    if columns.shape[1] == 0:
        return columns
    size = np.sqrt(np.sum(columns**2, axis=0))
    q, r = np.linalg.qr(columns / np.where(size > 0, size, 1.0))
    return q[:, np.abs(np.diagonal(r)) > 1e-10]


@dataclasses.dataclass(frozen=True)
class Screened:
    """One candidate of one shape against the innovations.

    Attributes:
        id: of the effect.
        instance: the effect at a plausible size.
        amplitudes: its amplitude parameters.
        estimate: their estimated values.
        statistic: chi-square distributed when the effect is absent; zero where the sign is unphysical.
        robust: the same with the variance of each second of data in place of the model's.
        limit: size of the amplitudes at which the statistic would be 20 on average.
        templates: projected change of the innovations per unit of each amplitude.
    """

    id: str
    instance: Any
    amplitudes: tuple[str, ...]
    estimate: Float[np.ndarray, " amplitude"]
    statistic: float
    robust: float
    limit: Float[np.ndarray, " amplitude"]
    templates: Rows


ALARM = 20.0


def screen(
    innovations: Innovations,
    error: np.ndarray,
    basis: Rows,
    instances: Sequence[Any],
    place: Any,
) -> list[Screened]:
    """Hold instances of candidates against the innovations.

    Args:
        place: gives for an effect, a parameter of it and the instance's other parameters the vector of shared values
            with only this amplitude switched on.
    """
    points, owners = [], []
    for number, instance in enumerate(instances):
        for amplitude in type(instance).amplitudes():
            points.append(place(instance, amplitude))
            owners.append((number, amplitude))
    base = innovations.at(np.asarray(innovations.space.values)[None])[:, 0]
    blocks = innovations.blocks()
    found = []
    by_instance: dict[int, list[tuple[str, np.ndarray]]] = {}
    for first in range(0, len(points), _AT_ONCE):
        columns = innovations.at(np.array(points[first : first + _AT_ONCE])) - base[:, None]
        columns = columns - basis @ (basis.T @ columns)
        for (number, amplitude), column in zip(owners[first : first + _AT_ONCE], columns.T, strict=True):
            size = float(np.asarray(getattr(instances[number], amplitude)))
            by_instance.setdefault(number, []).append((amplitude, column / size))
    for number, parts in by_instance.items():
        names = tuple(name for name, _ in parts)
        templates = np.stack([column for _, column in parts], axis=1)
        found.append(_screened(instances[number], names, templates, error, blocks))
    return found


def _screened(
    instance: Any, names: tuple[str, ...], templates: Rows, error: np.ndarray, blocks: np.ndarray
) -> Screened:
    from rtac_jax._parameter import declarations

    declared = declarations(instance)
    if not np.all(np.isfinite(templates)):
        none = np.zeros(len(names))
        return Screened(instance.id, instance, names, none, 0.0, 0.0, none + np.inf, 0 * np.nan_to_num(templates))
    gram = templates.T @ templates
    size = np.sqrt(np.diagonal(gram))
    with np.errstate(divide="ignore"):
        limit = np.sqrt(ALARM) / size
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
    left = error - explained
    # Scores by stretch of time: what a coloured noise does to them shows in their scatter.
    score = float(explained @ error)
    by_block = np.bincount(blocks, weights=explained * left)
    scatter = float(np.sum(by_block**2))
    robust = score**2 / scatter if scatter > 0 else 0.0
    return Screened(instance.id, instance, names, estimate, max(statistic, 0.0), robust, limit, templates)
