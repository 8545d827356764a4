"""The stages of a linear fit: simulation error with ever more modes, then prediction error with a model of the noise."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from estimators.linear.initialisation import Pair, next_pair, noise_starts, with_poles, with_residues
from estimators.linear.model_sets import Structure
from estimators.linear.predictor import Rows, Signals, rows, solve, tracks

_DAMPED = 0.1  # damping ratio of a second start
_SHORT = 12  # steps after which the best of several starts is known


class Raw(NamedTuple):
    """One condition as it was recorded: the input, compensated or not, and the output with its gaps bridged."""

    input: Float[np.ndarray, " sample"]
    output: Float[np.ndarray, " sample"]
    interval: float
    intersample: str


class Stage(NamedTuple):
    """A model set fitted to all conditions.

    Attributes:
        structure: the set.
        theta: the unknowns.
        data: with the scale in which they are expressed.
        rows: errors and Jacobian there.
        converged: of each condition.
    """

    structure: Structure
    theta: Float[np.ndarray, "condition unknown"]
    data: Signals
    rows: Rows
    converged: Bool[np.ndarray, " condition"]

    @property
    def mean_square(self) -> Float[np.ndarray, " condition"]:
        """Mean square of the prediction errors, squared unit of the output."""
        count = np.sum(np.asarray(self.data.present), axis=1)
        return np.sum(np.asarray(self.rows.error) ** 2, axis=1) / count * np.asarray(self.data.scale.error) ** 2


def simulation_stages(
    structure: Structure, data: Signals, raw: Sequence[Raw], candidates: Sequence[Pair], most: int
) -> Iterator[Stage]:
    """Fit output error with 1, 2, ... `most` modes, each begun from the one before and the best further pair of poles."""
    pairs: list[list[Pair]] = [[] for _ in raw]
    for modes in range(1, most + 1):
        zeros = structure.zeros - 2 * (structure.modes - modes)
        pairs = [
            [
                *known,
                next_pair(
                    one.input, one.output, one.interval, one.intersample, known, candidates, direct=zeros == 2 * modes
                ),
            ]
            for known, one in zip(pairs, raw, strict=True)
        ]
        simulation = Structure("output_error", modes, zeros, 0)
        theta = with_poles(simulation, pairs)
        theta = with_residues(simulation, theta, rows(simulation, theta, data))
        found = descend(simulation, theta, data)
        yield found
        pairs = poles_of(found)


def predictor_stage(structure: Structure, simulation: Stage) -> Stage:
    """Fit the same dynamics with H beside them."""
    if not structure.noise:
        return simulation
    data, theta, modes = simulation.data, simulation.theta, structure.modes
    errors = np.asarray(simulation.rows.error)
    found = tracks(simulation.structure, theta, data)[1]
    denominators = np.stack([_characteristic(t) for t in np.asarray(found.transition)])
    dynamics = simulation.structure.dynamics
    # Noise that resonates makes the simulation ring on undamped, where no small step shows that damping would help.
    damped = theta.copy()
    damped[:, modes : 2 * modes] = np.maximum(theta[:, modes : 2 * modes], theta[:, :modes] + np.log(2 * _DAMPED))
    still = np.zeros((len(theta), structure.noise_starts))
    best: Stage | None = None
    for noise in noise_starts(structure, errors, np.asarray(data.present), denominators):
        for each in (theta,) if np.array_equal(theta, damped) else (theta, damped):
            begin = np.concatenate([each[:, :dynamics], noise, each[:, dynamics:], still], axis=1)
            stage = descend(structure, begin, data, most=_SHORT)
            best = stage if best is None else _better(best, stage)
    assert best is not None
    return descend(structure, best.theta, best.data)


def descend(
    structure: Structure, theta: Float[np.ndarray, "condition unknown"], data: Signals, *, most: int = 60
) -> Stage:
    """Scale the errors to one where they are now, and minimise in at most so many steps."""
    data = _scaled(data, rows(structure, theta, data))
    solved = solve(structure, theta, data, most=most)
    return Stage(structure, solved.theta, data, rows(structure, solved.theta, data), solved.converged)


def poles_of(stage: Stage) -> list[list[Pair]]:
    """Return the pairs of poles of each condition."""
    m = stage.structure.modes
    a0, a1 = np.exp(2 * stage.theta[:, :m]), np.exp(stage.theta[:, m : 2 * m])
    return [[(float(x), float(y)) for x, y in zip(*each, strict=True)] for each in zip(a0, a1, strict=True)]


def _scaled(data: Signals, at: Rows) -> Signals:
    """Return the data scaled so that these errors have a root mean square of one.

    Damping and tolerance are then those of statistics.
    """
    count = np.sum(np.asarray(data.present), axis=1)
    size = np.sqrt(np.sum(np.asarray(at.error) ** 2, axis=1) / count) * np.asarray(data.scale.error)
    floor = 1e-12 * np.asarray(data.scale.output)
    scale = data.scale._replace(error=jnp.asarray(np.maximum(size, floor)))
    return dataclasses.replace(data, scale=scale)


def _better(one: Stage, other: Stage) -> Stage:
    """Return for each condition the stage with the smaller errors; both have one structure."""
    take = other.mean_square < one.mean_square
    theta = np.where(take[:, None], other.theta, one.theta)
    data = _scaled(one.data, rows(one.structure, theta, one.data))
    return Stage(
        one.structure, theta, data, rows(one.structure, theta, data), np.where(take, other.converged, one.converged)
    )


def _characteristic(transition: Float[np.ndarray, "mode 2 2"]) -> Float[np.ndarray, " order"]:
    found = np.ones(1)
    for each in transition:
        found = np.convolve(found, [1.0, -np.trace(each), np.linalg.det(each)])
    return found[1:]
