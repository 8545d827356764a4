"""The parameter space of a fit: which parameters are free, between which bounds, at which scale."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from estimators.core.bound_transform import to_physical, to_unconstrained
from rtac_jax.excitation import Real
from rtac_jax.programs.arrays import is_traced, to_jax

Physical = tuple[Float[Array, " parameter"], Float[Array, "each experiment"], Float[Array, "start experiment"]]
"""All shared parameters, those of each experiment, and the states at the start, SI units."""


class Unknowns(NamedTuple):
    """The unknowns of a fit, scaled to order one: shared parameters, parameters of each experiment, states at the start."""

    shared: Float[Array, " shared"]
    each: Float[Array, "each experiment"]
    start: Float[Array, "start experiment"]


class Space(eqx.Module):
    """The space of the unknowns: which parameters of the model they are, between which bounds, at which scale.

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
        known: what was measured beforehand of each shared parameter; its value where nothing was.
        known_std: its standard deviation, infinite where nothing was; both None where that is so of all of them.
    """

    values: Float[Real, " parameter"]
    active: Int[Real, " shared"]
    lower: Float[Real, " parameter"]
    upper: Float[Real, " parameter"]
    scale: Float[Real, " parameter"]
    each_values: Float[Real, "each experiment"]
    each_lower: Float[Real, " each"]
    each_upper: Float[Real, " each"]
    each_scale: Float[Real, " each"]
    start: Float[Real, "start experiment"]
    start_scale: Float[Real, "start experiment"]
    start_spread: Float[Real, "start experiment"]
    start_held: Float[Real, "start experiment"]
    names: tuple[str, ...] = eqx.field(static=True)
    each: tuple[str, ...] = eqx.field(static=True)
    known: Float[Real, " parameter"] | None = None
    known_std: Float[Real, " parameter"] | None = None

    def from_known(self, shared: Float[Array, " parameter"]) -> Float[Array, " constant"]:
        """Return how far the shared parameters are from what was measured of them, in standard deviations.

        Zero where nothing was measured; empty where that is so of all of them.
        """
        if self.known is None or self.known_std is None:
            return jnp.zeros(0)
        return (shared - self.known) / self.known_std

    def at_given_values(self) -> "Space":
        """Return the space without what is free or known beforehand, of which a pass at given values reads nothing.

        So models of which more or less is free share one compiled function.
        """
        return dataclasses.replace(self, active=np.zeros(0, dtype=int), known=None, known_std=None)

    def penalty(self, shared: Float[Array, " parameter"]) -> float:
        """Return the negative logarithm of the priors' density, less a constant; not within compiled code."""
        return 0.5 * float(np.sum(np.asarray(self.from_known(jnp.asarray(shared))) ** 2))

    def physical(self, unknowns: Unknowns) -> Physical:
        """Return all shared parameters, those of each experiment, and the states at the start, in SI units."""
        if is_traced(self, unknowns):
            return self._physical(unknowns)
        # To compile so little takes longer than all that it is ever asked for.
        known: tuple[Space, Unknowns] = jax.tree.map(np.asarray, (self, unknowns))
        shared, each, start = known[0]._physical(known[1])
        return to_jax(shared), to_jax(each), to_jax(start)

    def _physical(self, unknowns: Unknowns) -> tuple[Real, Real, Real]:
        """Return `physical`, in NumPy's arrays where all are."""
        shared = self._with_free(
            to_physical(unknowns.shared, *map(self._of_free, (self.lower, self.upper, self.scale)))
        )
        each = unknowns.each
        if len(each):
            each = to_physical(each, self.each_lower[:, None], self.each_upper[:, None], self.each_scale[:, None])
        if unknowns.start.shape[0] == 0:
            return shared, each, self.start
        return shared, each, self.start + (1.0 - self.start_held) * self.start_scale * unknowns.start

    def _of_free(self, values: Real) -> Real:
        """Return the values of what is free; 1 at a place past the end."""
        if isinstance(values, np.ndarray) and isinstance(self.active, np.ndarray):
            return np.append(values, 1.0)[np.minimum(self.active, len(values))]
        return jnp.asarray(values).at[self.active].get(mode="fill", fill_value=1.0)

    def _with_free(self, free: Real) -> Real:
        """Return all shared parameters with these values of those that are free."""
        if isinstance(free, np.ndarray):
            found = np.append(self.values, 0.0)
            found[np.minimum(self.active, len(self.values))] = free
            return found[:-1]
        return jnp.asarray(self.values).at[self.active].set(free, mode="drop")

    def unconstrained(self, *, start: bool = True, off_bounds: float = 0.0) -> Unknowns:
        """Return the unknowns at the present values; without `start` the states at the start are not among them.

        Args:
            start: whether the states at the start are among the unknowns.
            off_bounds: fraction of its scale by which a parameter exactly on a bound is moved inside, for a fit that begins
                there. On the bound itself a reparametrised parameter has next to no slope, and would stay.
        """
        rows = np.asarray(self.start)[: len(self.start) * start]
        return Unknowns(*map(to_jax, (*unconstrained_in_numpy(self, off_bounds=off_bounds), np.zeros_like(rows))))


def unconstrained_in_numpy(
    space: Space, *, off_bounds: float = 0.0
) -> tuple[Float[np.ndarray, " shared"], Float[np.ndarray, "each experiment"]]:
    """Return the shared and the other parameters as `Space.unconstrained` does, in arrays of NumPy."""

    def placed(value: np.ndarray, low: np.ndarray, high: np.ndarray, scale: np.ndarray) -> np.ndarray:
        by = np.minimum(off_bounds * scale, 0.5 * (high - low))
        inside = np.where(value <= low, low + by, np.where(value >= high, high - by, value))
        return to_unconstrained(inside, low, high, scale)

    index = np.asarray(space.active)
    inside = index < len(space.names)
    place = np.where(inside, index, 0)
    shared = placed(*(np.asarray(x)[place] for x in (space.values, space.lower, space.upper, space.scale)))
    each = np.asarray(space.each_values)
    if each.size:
        each = placed(each, *(np.asarray(x)[:, None] for x in (space.each_lower, space.each_upper, space.each_scale)))
    return np.where(inside, shared, 0.0), each


def number_of_unknowns(space: Space, unknowns: Unknowns) -> int:
    """Return the number of unknowns that a fit estimates: placeholders and starts that are held do not count."""
    shared = int(np.sum(np.asarray(space.active) < len(space.names)))
    starts = int(np.sum(1 - np.asarray(space.start_held))) if unknowns.start.shape[0] else 0
    return shared + int(np.size(unknowns.each)) + starts
