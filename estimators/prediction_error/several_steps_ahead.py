"""Predictions several samples ahead: the Kalman predictor's state at each sample, and from there the model alone."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.core.data import Data
from estimators.core.parameter_space import Physical, Space
from estimators.core.residual import states_at_start
from rtac_jax import RTAC
from rtac_jax.equations import delivered, sensor_outputs
from rtac_jax.programs import program
from rtac_jax.simulation import Steps, advance
from rtac_jax.time_loop import time_loop


@program
def predict_ahead(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    gain: Float[Array, "sample state output experiment"],
    *,
    ahead: int,
    substeps: Steps,
) -> Float[Array, "sample output experiment"]:
    """Return the outputs at each sample as the measurements up to `ahead` samples before it foretell them.

    All predictions that are under way, from 1 to `ahead` samples old, move on together, so that one pass over the samples
    gives all of them. The inputs over these samples are known. The first `ahead` samples are foretold from the start.

    Args:
        model: of the rig.
        data: of all experiments.
        space: of the model's parameters and starts.
        physical: shared parameters, those of each experiment, and states at the start, SI units.
        gain: of the Kalman filter, which corrects the state by the prediction error one sample ahead.
        ahead: samples, at least 1.
        substeps: of the integrator in each sample.

    Source: Ljung, System Identification (1999), section 3.2 (the k-step-ahead predictor), with the extended Kalman filter in
    place of a linear one.
    """
    shared, each, start = physical
    placed = model.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    excitation = delivered(placed, data.excitation)
    shape = excitation.sample_time.shape
    first = jnp.stack([jnp.broadcast_to(x, shape) for x in states_at_start(placed, start, excitation)])

    def outputs(state: Array) -> Array:
        return jnp.stack([jnp.broadcast_to(y, shape) for y in sensor_outputs(placed, tuple(state))])

    def one_sample(under_way: Array, row: dict[str, Any]) -> tuple[Array, Array]:
        error = (row["values"] - outputs(under_way[0])) * row["present"]
        mended = under_way[0] + jnp.sum(row["gain"] * error[None], axis=1)
        current, force = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))

        def forward(state: Array) -> Array:
            return jnp.stack(advance(placed, tuple(state), current, force, excitation, substeps=substeps))

        # The oldest is shown at this sample and has done its duty.
        moved = jax.vmap(forward)(jnp.concatenate([mended[None], under_way[:-1]]))
        return jnp.where(row["lasts"], moved, under_way), outputs(under_way[-1])

    rows = {
        "current": excitation.current, "force": excitation.force, "values": data.values, "present": data.present,
        "gain": gain, "lasts": excitation.lasts(data.room),
    }  # fmt: skip
    under_way = jnp.broadcast_to(first, (ahead, *first.shape))
    return time_loop(one_sample, under_way, rows, room=data.room, samples=data.length)[1]
