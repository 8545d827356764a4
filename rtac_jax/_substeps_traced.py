"""Runge-Kutta steps per sample for a model whose values are not known yet, because `jax.jit`, `grad` or `vmap` traces it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from rtac_jax._rtac import RTAC
from rtac_jax.excitation import Excitation
from rtac_jax.simulation import rate_jacobians


def substeps_traced(model: RTAC, excitation: Excitation, *, stability: float, most: int) -> Int[Array, ""]:
    """Return what `substeps_for` returns, as an array; in a batch the most that one of it needs.

    Args:
        model: that JAX traces.
        excitation: the inputs, with their sample times.
        stability: step times fastest rate, at most.
        most: the largest number of steps returned.
    """
    model, sample_time = jax.lax.stop_gradient((model, excitation.sample_time))
    first = jax.tree.map(lambda leaf: jnp.ravel(leaf)[0], model)
    rates = jnp.abs(jnp.linalg.eigvals(rate_jacobians(first)))
    wanted = jnp.ceil(jnp.max(sample_time) * jnp.max(rates) / stability)
    return _most_of_batch(jnp.clip(jnp.nan_to_num(wanted, nan=1.0), 1, most).astype(int))


@jax.custom_batching.custom_vmap
def _most_of_batch(count: Int[Array, ""]) -> Int[Array, ""]:
    """Return the same number; under `jax.vmap` the largest of the batch, so that one loop serves all of it."""
    return count


@_most_of_batch.def_vmap
def _most_of_batch_rule(size: int, batched: list[bool], count: Array) -> tuple[Array, bool]:
    del size, batched
    return _most_of_batch(jnp.max(count, axis=0)), False
