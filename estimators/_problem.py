"""Model, recording, noise and free parameters make one residual, in units of its standard deviation."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from estimators._transform import to_physical, to_unconstrained
from rtac_jax import RTAC, Excitation
from rtac_jax._excitation import BEYOND
from rtac_jax._simulate import Steps, trajectories
from rtac_jax._time_loop import room_for
from rtac_jax.measurement import OUTPUTS, Experiment

CHANNELS = tuple(OUTPUTS)
Outputs3 = Float[Array, "sample output experiment"]


class Data(eqx.Module):
    """Experiments as arrays of one shape, with room for more samples than the longest has.

    Attributes:
        excitation: the inputs.
        values: outputs in the order of `CHANNELS`; zero where there is none.
        present: 1 where an output was measured, else 0.
        trusted: 0 where a filter follows the outputs but its likelihood and its innovations do not count, else 1.
        length: samples of the longest experiment, or of the part of all experiments that is run through.
    """

    excitation: Excitation
    values: Outputs3
    present: Outputs3
    trusted: Float[Array, "sample experiment"]
    length: Int[Array, ""]

    @classmethod
    def of(cls, experiments: Sequence[Experiment]) -> "Data":
        """Stack experiments of any lengths and channels."""
        samples = max(e.samples for e in experiments)
        values = np.full((room_for(samples + BEYOND), len(CHANNELS), len(experiments)), np.nan)
        for column, experiment in enumerate(experiments):
            for row, channel in enumerate(CHANNELS):
                if channel in experiment.outputs:
                    values[: experiment.samples, row, column] = experiment.outputs[channel].values
        present = np.isfinite(values)
        return cls(
            Excitation.of(experiments, room=len(values)),
            jnp.asarray(np.where(present, values, 0.0)),
            jnp.asarray(present.astype(float)),
            jnp.ones((values.shape[0], values.shape[2])),
            jnp.asarray(samples),
        )

    @property
    def counted(self) -> Outputs3:
        """1 where an output was measured and counts, else 0."""
        return self.present * self.trusted[:, None]

    @property
    def room(self) -> int:
        """Length of the arrays."""
        return self.values.shape[0]

    @property
    def samples(self) -> int:
        """Length of the longest experiment; not within compiled code."""
        return int(self.length)

    @property
    def experiments(self) -> int:
        """How many there are."""
        return self.values.shape[2]


class Unknowns(NamedTuple):
    """What a fit varies, scaled to order one: shared parameters, parameters of each experiment, states at the start."""

    shared: Float[Array, " shared"]
    each: Float[Array, "each experiment"]
    start: Float[Array, "start experiment"]


class Space(eqx.Module):
    """Where the unknowns live: which parameters of the model they are, between which bounds, at which scale.

    Attributes:
        values: all shared parameters of the model.
        active: places in `values` of those that are free; a place past the end is an unknown that does nothing, so
            that problems with different numbers of free parameters share one compiled function.
        lower, upper, scale: of all shared parameters.
        each_values, each_lower, each_upper, each_scale: of the parameters that each experiment has for itself.
        start: expected states at the start, for the rigid body absolute, for an effect beside its equilibrium.
        start_scale: their scales.
        start_spread: standard deviations of what is known of them beforehand; infinite where nothing is.
        start_held: 1 where a state at the start is known exactly.
        names, each: names of the parameters.
    """

    values: Float[Array, " parameter"]
    active: Int[Array, " shared"]
    lower: Float[Array, " parameter"]
    upper: Float[Array, " parameter"]
    scale: Float[Array, " parameter"]
    each_values: Float[Array, "each experiment"]
    each_lower: Float[Array, " each"]
    each_upper: Float[Array, " each"]
    each_scale: Float[Array, " each"]
    start: Float[Array, "start experiment"]
    start_scale: Float[Array, "start experiment"]
    start_spread: Float[Array, "start experiment"]
    start_held: Float[Array, "start experiment"]
    names: tuple[str, ...] = eqx.field(static=True)
    each: tuple[str, ...] = eqx.field(static=True)

    @eqx.filter_jit
    def physical(self, unknowns: Unknowns) -> tuple[Array, Array, Array]:
        """All shared parameters, those of each experiment, and the states at the start, in SI units."""

        def of_free(values: Array) -> Array:
            return values.at[self.active].get(mode="fill", fill_value=1.0)

        free = to_physical(
            unknowns.shared,
            of_free(self.lower),
            of_free(self.upper),
            of_free(self.scale),
        )
        shared = self.values.at[self.active].set(free, mode="drop")
        each = to_physical(unknowns.each, self.each_lower[:, None], self.each_upper[:, None], self.each_scale[:, None])
        if unknowns.start.shape[0] == 0:
            return shared, each, self.start
        return shared, each, self.start + (1.0 - self.start_held) * self.start_scale * unknowns.start

    def unconstrained(self, *, start: bool = True, off_bounds: float = 0.0) -> Unknowns:
        """The unknowns at the present values; without `start` the states at the start are not among them.

        Args:
            off_bounds: share of its scale by which a parameter exactly on a bound is moved inside, for a fit that begins
                there. On the bound itself a reparametrised parameter has next to no slope, and would stay.
        """

        def placed(value: np.ndarray, low: np.ndarray, high: np.ndarray, scale: np.ndarray) -> np.ndarray:
            by = np.minimum(off_bounds * scale, 0.5 * (high - low))
            inside = np.where(value <= low, low + by, np.where(value >= high, high - by, value))
            return to_unconstrained(inside, low, high, scale)

        index = np.asarray(self.active)
        inside = index < len(self.names)
        place = np.where(inside, index, 0)
        shared = placed(*(np.asarray(x)[place] for x in (self.values, self.lower, self.upper, self.scale)))
        each = placed(
            np.asarray(self.each_values),
            *(np.asarray(x)[:, None] for x in (self.each_lower, self.each_upper, self.each_scale)),
        )
        rows = np.asarray(self.start)[: len(self.start) * start]
        shared = jnp.asarray(np.where(inside, shared, 0.0))
        return Unknowns(shared, jnp.asarray(each), jnp.asarray(np.zeros_like(rows)))


def states_at_start(model: RTAC, start: Array, excitation: Excitation) -> tuple[Any, ...]:
    """The model's whole state from the estimated part of it: the rigid body's, and effects' offsets from equilibrium."""
    state = list(model.start(tuple(start[:4]), excitation.first_current()))
    row, place = 4, 4
    for effect in model.effects:
        for _ in effect.states:
            if effect.free_start:
                state[place] = state[place] + start[row]
                row += 1
            place += 1
    return tuple(state)


def start_rows(model: RTAC) -> tuple[str, ...]:
    """Names of the states at the start that a fit estimates."""
    names = tuple(model.states)
    return names[:4] + tuple(
        f"{effect.id}.{state}" for effect in model.effects if effect.free_start for state in effect.states
    )


def predict(
    model: RTAC,
    data: Data,
    space: Space,
    physical: tuple[Array, Array, Array],
    *,
    substeps: Steps,
    gain: Array | None = None,
    impulses: Array | None = None,
) -> Outputs3:
    """Outputs of the model with these parameters: simulated, or predicted one sample ahead where there is a gain.

    Impulses strike what is simulated; see `trajectories`.
    """
    shared, each, start = physical
    values: Mapping[str, Any] = dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True))
    placed = model.with_values(values)
    return trajectories(
        placed,
        states_at_start(placed, start, data.excitation),
        data.excitation,
        room=data.room,
        samples=data.length,
        substeps=substeps,
        measured=None if gain is None else (data.values, data.present),
        gain=gain,
        impulses=impulses,
    )


def whitened(whitener: Array, error: Array) -> Array:
    """The error in units of its standard deviation: whitener [sample or 1, row, output, experiment] times error."""
    return sum(whitener[:, :, j] * error[:, None, j] for j in range(error.shape[1]))  # type: ignore[return-value] - sum begins with 0


def residual(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> tuple[Outputs3, Float[Array, "start experiment"]]:
    """The one residual: whitened output errors, and how far the start is from what is known of it."""
    physical = space.physical(unknowns)
    error = (data.values - predict(model, data, space, physical, substeps=substeps, gain=gain)) * data.present
    if unknowns.start.shape[0] == 0:
        return whitened(whitener, error), unknowns.start
    known = jnp.where(space.start_held > 0, unknowns.start, (physical[2] - space.start) / space.start_spread)
    return whitened(whitener, error), known


def triangle(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> Float[Array, "experiment row column"]:
    """Residual and Jacobian of each experiment, compressed without loss to the triangular factor of [J, r].

    Its columns are the shared unknowns, the experiment's own, its start, and last the residual. Sums of squares, gradients
    and Gauss-Newton matrices are those of the whole residual. Because experiments do not depend on each other's unknowns, one
    direction serves the same unknown of all experiments, and the cost does not grow with their number.
    """
    count, width = data.experiments, [len(unknowns.shared), len(unknowns.each), len(unknowns.start)]
    directions = sum(width)

    def basis(block: int, like: Array) -> Array:
        first = sum(width[:block])
        rows = jnp.eye(directions)[:, first : first + width[block]]
        return rows if like.ndim == 1 else jnp.broadcast_to(rows[:, :, None], (directions, *like.shape))

    tangents = Unknowns(*(basis(block, leaf) for block, leaf in enumerate(unknowns)))

    def along(tangent: Unknowns) -> Any:
        return jax.jvp(
            lambda at: residual(model, data, space, at, whitener, substeps=substeps, gain=gain), (unknowns,), (tangent,)
        )

    (error, known), (d_error, d_known) = jax.vmap(along, out_axes=(None, -1))(tangents)
    columns = jnp.concatenate([d_error, error[..., None]], axis=-1)
    rows = jnp.moveaxis(columns, 2, 0).reshape(count, -1, directions + 1)
    prior = jnp.moveaxis(jnp.concatenate([d_known, known[..., None]], axis=-1), 1, 0)
    rows = jnp.concatenate([rows, prior], axis=1)
    factor = _triangular(rows)
    # A positive diagonal makes the factor a continuous function of the unknowns.
    sign = jnp.where(jnp.diagonal(factor, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return factor * sign[:, :, None]


def _triangular(rows: Float[Array, "experiment row column"]) -> Float[Array, "experiment column column"]:
    """The triangular factor of each block, block by block: LAPACK on a tall matrix starts threads that fight for cores."""
    count, _, width = rows.shape
    height = max(256, 4 * width)
    while rows.shape[1] > 2 * height:
        parts = -(-rows.shape[1] // height)
        rows = jnp.pad(rows, ((0, 0), (0, parts * height - rows.shape[1]), (0, 0)))
        rows = _each_r(rows.reshape(count * parts, height, width)).reshape(count, parts * width, width)
    rows = jnp.pad(rows, ((0, 0), (0, max(0, width - rows.shape[1])), (0, 0)))
    return _each_r(rows)


def _each_r(rows: Float[Array, "block row column"]) -> Float[Array, "block column column"]:
    """The triangular factors of blocks, one after the other: a batch waits within XLA's threads for others of these.

    Two threads that factor batches at the same time would wait for each other for ever.
    """
    return jax.lax.map(lambda block: jnp.linalg.qr(block, mode="r"), rows)
