"""Fisher information: the only place where parameter covariance and identifiability are computed."""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from estimators.core.bound_transform import slopes
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.results import NotIdentifiableError
from estimators.core.undetermined import UNDETERMINED

_SCALES = ("total_mass", "arm_inertia")
_TAKES_PART = 0.2  # fraction of a direction from which on a parameter is named with it

# The least that a parameter is taken to show, and the least slope of its stand-in as a fraction of its size: far below whatever
# rounding leaves, and of squares that are still numbers. What shows nothing at all gets a deviation of 1e100 times its size.
_LEAST = 1e-100
_NOTHING = 1e6  # times its size, from which on a deviation is of what is not shown at all


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
        own: the covariance were all exact that is held at estimates of something else; None where nothing is.
    """

    names: tuple[str, ...]
    covariance: Float[np.ndarray, "parameter parameter"]
    directions: Float[np.ndarray, "direction parameter"]
    deviations: Float[np.ndarray, " direction"]
    parts: Float[np.ndarray, "experiment parameter parameter"] | None = None
    scores: Float[np.ndarray, "experiment parameter"] | None = None
    own: Float[np.ndarray, "parameter parameter"] | None = None

    @property
    def own_covariance(self) -> Float[np.ndarray, "parameter parameter"]:
        """Return the covariance were all that is held exact: the inverse of the Gauss-Newton matrix."""
        return self.covariance if self.own is None else self.own

    def undetermined(self, beside: Collection[str] = ()) -> list[str]:
        """Describe every combination of parameters that the data leave free.

        Args:
            beside: ids of effects whose parameters may be free by themselves, as a velocity of friction that is absent.
        """
        said = []
        for direction, deviation in zip(self.directions, self.deviations, strict=True):
            if deviation < UNDETERMINED:
                continue
            parts = [
                (name, fraction)
                for name, fraction in zip(self.names, direction, strict=True)
                if abs(fraction) > _TAKES_PART
            ]
            if all(name.split(".")[0] in beside for name, _ in parts):
                continue
            if len(parts) == 1:
                said.append(f"{parts[0][0]} has no effect on what was measured")
            else:
                signs = {fraction > 0 for _, fraction in parts}
                how = "scaled together" if len(signs) == 1 else "traded against each other"
                said.append(f"{', '.join(name for name, _ in parts)} may be {how}")
        return said

    def looseness(self, prefix: str) -> float:
        """Return the largest relative deviation of a combination in which parameters whose names begin so take part.

        Args:
            prefix: of the names.
        """
        taking = [
            any(abs(s) > _TAKES_PART for n, s in zip(self.names, d, strict=True) if n.startswith(prefix))
            for d in self.directions
        ]
        return float(np.max(self.deviations[np.array(taking, dtype=bool)], initial=0.0)) if any(taking) else 0.0

    def weakest(self, *, above: float = 0.1) -> list[str]:
        """Describe what these data determine, but worse than to this fraction of its size, the worst first."""
        said = []
        for direction, deviation in zip(self.directions, self.deviations, strict=True):
            if deviation <= above:
                break
            if deviation >= UNDETERMINED:
                continue
            fractions = np.abs(direction)
            names = [n for n, fraction in zip(self.names, fractions, strict=True) if fraction > 0.3 * np.max(fractions)]
            if len(names) == 1:
                said.append(f"these data hardly show {names[0]} (+-{_percent(deviation)})")
                continue
            # Only what all of them do together is unknown; a ratio or a sum of them may be known well.
            rest = f"{', '.join(names[:-1])} from {names[-1]}"
            said.append(
                f"these data do not separate {rest} (their common direction is known to +-{_percent(deviation)})"
            )
        return said

    def weak_sentences(self) -> list[str]:
        """Return `weakest` as sentences."""
        return [f"{text[0].upper()}{text[1:]}." for text in self.weakest()]

    def require_determined(self) -> None:
        """Refuse data that leave parameters free.

        Raises:
            NotIdentifiableError: names what is free.
        """
        if said := self.undetermined():
            # One that stands in /rig already is not free, and so in none of these.
            scales = " or ".join(name for name in _SCALES if any(name in text for text in said))
            known = f"Give {scales} in /rig: a known constant fixes the scale. " if scales else ""
            raise NotIdentifiableError(
                f"The data leave {len(said)} combination(s) of parameters free: {'; '.join(said)}. {known}Fix a parameter "
                "(model.fix, or --fix of rtac), or add an experiment that excites it.",
                self._unseen(),
            )

    def _unseen(self) -> tuple[str, ...]:
        """Return the names of effects' parameters that show nowhere; none where anything else is free, or all are."""
        free = self.directions[self.deviations >= UNDETERMINED]
        # Of what shows nothing at all any directions may come.
        alone = np.flatnonzero(np.sum(free**2, axis=0) > 1 - _TAKES_PART**2)
        names = tuple(self.names[int(i)] for i in alone)
        shown = len(names) == len(free) < len(self.names)
        return names if shown and all("." in name for name in names) else ()


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
    floor = max(1e-13 * singular[0], _LEAST)
    deviations = 1.0 / np.maximum(singular, floor)
    half = directions.T * deviations
    covariance = (half @ half.T) * np.outer(size, size)
    return Information(tuple(names), covariance, directions[::-1], deviations[::-1])


def information_of_covariance(covariance: np.ndarray, names: Sequence[str], size: np.ndarray) -> Information:
    """Compute identifiability from a covariance of physical parameters, and their sizes."""
    variances, directions = np.linalg.eigh(covariance / np.outer(size, size))
    deviations = np.sqrt(np.maximum(variances[::-1], 0.0))
    return Information(tuple(names), covariance, directions.T[::-1], deviations)


def slope_of(space: Space, unknowns: Unknowns) -> np.ndarray:
    """Return the derivative of each free physical parameter by its unconstrained stand-in, kept off zero at a bound."""
    index = np.asarray(space.active)
    place = np.where(index < len(space.names), index, 0)
    bounds = (np.asarray(x)[place] for x in (space.lower, space.upper, space.scale))
    return np.maximum(slopes(np.asarray(unknowns.shared), *bounds), _LEAST * sizes_of(space, unknowns))


def each_slope(space: Space, unknowns: Unknowns) -> Float[np.ndarray, "each experiment"]:
    """Return the same derivative for the parameters of each experiment."""
    bounds = (np.asarray(x)[:, None] for x in (space.each_lower, space.each_upper, space.each_scale))
    scale = np.asarray(space.each_scale)[:, None]
    return np.maximum(slopes(np.asarray(unknowns.each), *bounds), _LEAST * scale)


def each_deviations(factor: np.ndarray, space: Space, unknowns: Unknowns) -> Float[np.ndarray, "each experiment"]:
    """Return the standard deviations of the parameters of each experiment, all other unknowns following.

    Args:
        factor: [experiment row column], as `information` takes it.
        space: of the unknowns.
        unknowns: at the optimum.
    """
    inside = np.asarray(space.active) < len(space.names)
    shared, own = int(np.sum(inside)), len(space.each)
    if not own:
        return np.zeros((0, len(factor)))
    slope = each_slope(space, unknowns)
    of_shared = slope_of(space, unknowns)[inside] / sizes_of(space, unknowns)[inside]
    parts = []
    for column, block in enumerate(np.asarray(factor)):
        rest = block[:, len(inside) : -1].copy()
        rest[:, :own] /= slope[:, column] / np.asarray(space.each_scale)
        whole = np.concatenate([block[:, : len(inside)][:, inside] / of_shared, rest], axis=1)
        parts.append(whole.T @ whole)
    inner = [_inverse(p[shared:, shared:]) for p in parts]
    through = [i @ p[shared:, :shared] for i, p in zip(inner, parts, strict=True)]
    between = sum(p[:shared, :shared] - p[:shared, shared:] @ t for p, t in zip(parts, through, strict=True))
    common = _inverse(np.asarray(between))
    variance = [np.diagonal(i + t @ common @ t.T)[:own] for i, t in zip(inner, through, strict=True)]
    return np.sqrt(np.stack(variance, axis=1)) * np.asarray(space.each_scale)[:, None]


def told_deviations(
    factor: np.ndarray, space: Space, unknowns: Unknowns
) -> dict[str, Float[np.ndarray, " experiment"]]:
    """Return `each_deviations` by name, NaN where an experiment tells nothing of a parameter."""
    deviations = each_deviations(factor, space, unknowns)
    size = np.maximum(np.abs(np.asarray(space.physical(unknowns)[1])), np.asarray(space.each_scale)[:, None])
    return dict(zip(space.each, np.where(deviations < _NOTHING * size, deviations, np.nan), strict=True))


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric matrix without negative eigenvalues; directions that show nothing become very doubtful."""
    if not len(matrix):
        return matrix
    size = np.sqrt(np.maximum(np.diagonal(matrix), _LEAST))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    return (vectors / np.maximum(values, 1e-15 * len(values))) @ vectors.T / np.outer(size, size)


def sizes_of(space: Space, unknowns: Unknowns) -> np.ndarray:
    """Return the size of each free parameter, to which a relative deviation refers."""
    index = np.asarray(space.active)
    inside = index < len(space.names)
    place = np.where(inside, index, 0)
    present = np.abs(np.asarray(space.physical(unknowns)[0])[place])
    # At zero, as for an effect that turns out to be absent, the scale of what is plausible stands in.
    return np.where(inside, np.maximum(present, 0.1 * np.asarray(space.scale)[place]), 1.0)


def _percent(fraction: float) -> str:
    return f"{float(f'{100 * fraction:.2g}'):g} %"
