"""Fisher information: the only place where parameter covariance and identifiability are computed."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.bound_transform import slopes
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.results import NotIdentifiableError

# A direction along which all free parameters may move by more than this fraction of their size within one standard
# deviation is not determined by the data.
_UNDETERMINED = 10.0

_ROOM = 32  # parameters are padded to a multiple of this, so that one compiled function serves most models


@dataclasses.dataclass(frozen=True)
class Information:
    """The Fisher information on the shared parameters, with those of each experiment and the starts integrated out.

    Attributes:
        names: of the free shared parameters.
        covariance: of their physical values.
        directions: singular directions of the sensitivity in parameters divided by their size, best determined last.
        deviations: standard deviation along each of them, relative.
        parts: Gauss-Newton matrix of each experiment, in physical parameters.
        scores: gradient of each experiment's half sum of squares at the optimum.
    """

    names: tuple[str, ...]
    covariance: Float[np.ndarray, "parameter parameter"]
    directions: Float[np.ndarray, "direction parameter"]
    deviations: Float[np.ndarray, " direction"]
    parts: Float[np.ndarray, "experiment parameter parameter"] | None = None
    scores: Float[np.ndarray, "experiment parameter"] | None = None

    def undetermined(self) -> list[str]:
        """Describe every combination of parameters that the data leave free."""
        said = []
        for direction, deviation in zip(self.directions, self.deviations, strict=True):
            if deviation < _UNDETERMINED:
                continue
            parts = [(name, share) for name, share in zip(self.names, direction, strict=True) if abs(share) > 0.2]
            if len(parts) == 1:
                said.append(f"{parts[0][0]} has no effect on what was measured")
            else:
                signs = {share > 0 for _, share in parts}
                how = "scaled together" if len(signs) == 1 else "traded against each other"
                said.append(f"{', '.join(name for name, _ in parts)} may be {how}")
        return said

    def weakest(self, *, above: float = 0.1) -> list[str]:
        """Describe what these data determine, but worse than to this fraction of its size, the worst first."""
        said = []
        for direction, deviation in zip(self.directions, self.deviations, strict=True):
            if deviation <= above:
                break
            if deviation >= _UNDETERMINED:
                continue
            shares = np.abs(direction)
            names = [n for n, share in zip(self.names, shares, strict=True) if share > 0.3 * np.max(shares)]
            if len(names) == 1:
                said.append(f"these data hardly show {names[0]} (+-{_percent(deviation)})")
                continue
            # Only what all of them do together is unknown; a ratio or a sum of them may be known well.
            rest = f"{', '.join(names[:-1])} from {names[-1]}"
            said.append(
                f"these data do not separate {rest} (their common direction is known to +-{_percent(deviation)})"
            )
        return said

    def require_determined(self) -> None:
        """Refuse data that leave parameters free.

        Raises:
            NotIdentifiableError: names what is free.
        """
        if said := self.undetermined():
            raise NotIdentifiableError(
                f"The data leave {len(said)} combination(s) of parameters free: {'; '.join(said)}. Give a known constant "
                "in /rig (total_mass or arm_inertia fixes the scale), fix a parameter (model.fix), or add an experiment that "
                "excites it."
            )


def information(factor: np.ndarray, space: Space, unknowns: Unknowns) -> Information:
    """Compute covariance and identifiability from the triangular factors of the experiments.

    Args:
        factor: [experiment row column], of a residual in units of its standard deviation, at the optimum.
        space: of the parameters.
        unknowns: the optimum.

    Source: Gauss-Markov; Ljung, System Identification (1999), section 9.4.
    """
    shared = len(unknowns.shared)
    rows = []
    for block in np.asarray(factor):
        # Rotate the experiment's own unknowns away: what remains below them is what it says of the shared ones.
        own = block[:, shared:-1]
        order = np.concatenate([own, block[:, :shared], block[:, -1:]], axis=1)
        triangle = np.asarray(np.linalg.qr(order, mode="r"))
        rows.append(triangle[own.shape[1] :, own.shape[1] :])
    inside = np.asarray(space.active) < len(space.names)
    names = tuple(space.names[int(i)] for i in np.asarray(space.active)[inside])
    slope = slope_of(space, unknowns)[inside]
    blocks = [block[:, :shared][:, inside] / slope for block in rows]
    found = information_of(np.concatenate(blocks), names, sizes_of(space, unknowns)[inside])
    return dataclasses.replace(
        found,
        parts=np.stack([block.T @ block for block in blocks]),
        scores=np.stack([block.T @ whole[:, -1] for block, whole in zip(blocks, rows, strict=True)]),
    )


def information_of(matrix: np.ndarray, names: Sequence[str], size: np.ndarray) -> Information:
    """Compute covariance and identifiability from a whitened Jacobian by physical parameters, and their sizes."""
    if not names:
        return Information((), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0))
    _, singular, directions = np.linalg.svd(matrix * size, full_matrices=True)
    singular = np.concatenate([singular, np.zeros(len(names) - len(singular))])
    # Numbers below the rounding of the factors say nothing.
    floor = 1e-13 * max(singular[0], 1e-300)
    deviations = 1.0 / np.maximum(singular, floor)
    half = directions.T * deviations
    covariance = (half @ half.T) * np.outer(size, size)
    return Information(tuple(names), covariance, directions[::-1], deviations[::-1])


def slope_of(space: Space, unknowns: Unknowns) -> np.ndarray:
    """Return the derivative of each free physical parameter by its unconstrained stand-in, kept off zero at a bound."""
    index = np.asarray(space.active)
    place = np.where(index < len(space.names), index, 0)
    count = len(index)
    shared = np.zeros(-(-count // _ROOM) * _ROOM)
    at = [
        np.concatenate([np.asarray(x)[place], np.ones(len(shared) - count)])
        for x in (space.lower, space.upper, space.scale)
    ]
    shared[:count] = np.asarray(unknowns.shared)
    slope = np.asarray(slopes(*(jnp.asarray(x) for x in (shared, *at))))[:count]
    return np.where(np.abs(slope) > 1e-12 * sizes_of(space, unknowns), slope, 1e-12 * sizes_of(space, unknowns))


def each_slope(space: Space, unknowns: Unknowns) -> Float[np.ndarray, "each experiment"]:
    """Return the same derivative for the parameters of each experiment, by central differences of the exact map."""
    step = 1e-6
    ahead, behind = (
        np.asarray(space.physical(unknowns._replace(each=unknowns.each + side))[1]) for side in (step, -step)
    )
    return (ahead - behind) / (2 * step)


def sizes_of(space: Space, unknowns: Unknowns) -> np.ndarray:
    """Return the size of each free parameter, to which a relative deviation refers."""
    index = np.asarray(space.active)
    inside = index < len(space.names)
    place = np.where(inside, index, 0)
    present = np.abs(np.asarray(space.physical(unknowns)[0])[place])
    # At zero, as for an effect that turns out to be absent, the scale of what is plausible stands in.
    return np.where(inside, np.maximum(present, 0.1 * np.asarray(space.scale)[place]), 1.0)


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"
