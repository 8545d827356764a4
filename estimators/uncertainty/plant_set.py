"""A set of plants, wherever they come from, as complex numbers on one grid of frequencies."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import control as ct
import numpy as np
from jaxtyping import Complex128, Float64

from estimators.frequency_response.response import FrequencyResponses

System = ct.FrequencyResponseData | ct.StateSpace | ct.TransferFunction
Responses = FrequencyResponses | Sequence[System] | Complex128[np.ndarray, "condition frequency"]

_COUNTED = re.compile(r"sys\[\d+\](\$\w+)?")
_DEFECTIVE = 1e10  # condition of the eigenvectors beyond which they are not used


class PlantSet(NamedTuple):
    """The responses on a grid, what else is known of them, and the systems themselves where there are any.

    Attributes:
        names: of the conditions.
        omega: [rad/s].
        plants: [condition, frequency].
        std: of the responses, or None.
        amplitude: root mean square of each condition's input, or None.
        systems: parametric plants, which can be evaluated between the points of the grid; else None.
    """

    names: tuple[str, ...]
    omega: Float64[np.ndarray, " frequency"]
    plants: Complex128[np.ndarray, "condition frequency"]
    std: Float64[np.ndarray, "condition frequency"] | None
    amplitude: Float64[np.ndarray, " condition"] | None
    systems: tuple[Any, ...] | None


def gather(responses: Responses, omega: Float64[np.ndarray, " grid"] | None) -> PlantSet:
    """Gather responses on one grid.

    Raises:
        ValueError: grids differ, a grid is missing, out of order or not positive, or a value is bad.
    """
    systems: tuple[Any, ...] | None = None
    std = amplitude = None
    if isinstance(responses, FrequencyResponses):
        names = tuple(one.name for one in responses)
        grid, plants, std = responses.frequency, responses.response, responses.std
        amplitude = np.array([one.input_rms for one in responses])
    elif isinstance(responses, np.ndarray):
        if omega is None or np.shape(omega) != responses.shape[1:]:
            raise ValueError(f"omega: give the {responses.shape[1]} frequencies [rad/s] of the responses.")
        if not np.any(np.imag(responses)):
            raise ValueError("responses: are all real, as magnitudes are; give complex responses, with their phase.")
        names = tuple(f"condition_{number + 1}" for number in range(len(responses)))
        grid, plants = np.asarray(omega, dtype=np.float64), responses
    else:
        names = tuple(_name_of(one, f"condition_{i + 1}") for i, one in enumerate(responses))
        each: list[Any] = list(responses)
        for name, one in zip(names, each, strict=True):
            if one.ninputs != 1 or one.noutputs != 1:
                raise ValueError(f"{name}: has {one.ninputs} inputs and {one.noutputs} outputs; choose one of each.")
            if one.dt:
                raise ValueError(f"{name}: is a discrete-time system; give its continuous-time equivalent.")
        if all(isinstance(one, ct.FrequencyResponseData) for one in each):
            grid = np.asarray(each[0].omega, dtype=np.float64) if len(each) else np.ones(1)
            for name, one in zip(names, each, strict=True):
                if len(one.omega) != len(grid) or not np.allclose(one.omega, grid, rtol=1e-9):
                    raise ValueError(f"{name}: has other frequencies than {names[0]}; bring all to one grid.")
            plants = np.array([np.ravel(one.frdata) for one in each], dtype=np.complex128).reshape(-1, len(grid))
        elif any(isinstance(one, ct.FrequencyResponseData) for one in responses):
            raise ValueError("responses: give only FRD, or only transfer functions and state-space systems.")
        else:
            if omega is None:
                raise ValueError("omega: give the frequencies [rad/s] at which the systems are to be covered.")
            systems, grid = tuple(responses), np.asarray(omega, dtype=np.float64)
            plants = evaluate(systems, grid)
    if grid.ndim != 1 or len(grid) < 2 or not np.all(np.isfinite(grid)) or grid[0] <= 0 or np.any(np.diff(grid) <= 0):
        raise ValueError("omega: must be positive and increasing, at least two frequencies [rad/s].")
    if not np.all(np.isfinite(plants)):
        bad = names[int(np.argmax(~np.isfinite(plants).all(axis=1)))]
        raise ValueError(f"{bad}: has a response that is not finite; leave the condition or the frequency out.")
    return PlantSet(names, grid, plants, std, amplitude, systems)


def _name_of(system: System, numbered: str) -> str:
    """Return the name that somebody gave to a system, or its number, where the name is but python-control's own count."""
    name = str(getattr(system, "name", None) or "")
    return numbered if not name or _COUNTED.fullmatch(name) else name


def require_stable(found: PlantSet) -> None:
    """Refuse a parametric plant that is not stable.

    With P_0, W and Delta stable, no P_0 + Delta W and no (1 + Delta W) P_0 is it, so that what small gain promises
    would not hold for it. Responses do not show whether a plant is stable; of them it is taken for granted.

    Raises:
        ValueError: a plant has a pole that is not in the left half plane.
    """
    for name, system in zip(found.names, found.systems or (), strict=False):
        poles: Any = np.asarray(system.poles())
        if len(poles) and not np.max(poles.real) < 0:
            raise ValueError(
                f"{name}: has a pole at {poles[np.argmax(poles.real)]:.4g}, and no plant of such an envelope is unstable or "
                "integrates; leave the condition out, or take off a mode that the output does not show."
            )


def evaluate(
    systems: Sequence[Any], omega: Float64[np.ndarray, " frequency"]
) -> Complex128[np.ndarray, "condition frequency"]:
    """Return the responses of many scalar systems at once; those of one order together."""
    s = 1j * omega
    result = np.empty((len(systems), len(omega)), dtype=np.complex128)
    orders: dict[int, list[int]] = {}
    for number, one in enumerate(systems):
        if isinstance(one, ct.TransferFunction):
            result[number] = np.polyval(one.num[0][0], s) / np.polyval(one.den[0][0], s)
        else:
            orders.setdefault(one.nstates, []).append(number)
    for order, members in orders.items():
        a, b, c, d = (np.stack([np.asarray(getattr(systems[m], part)) for m in members]) for part in "ABCD")
        if order == 0:
            result[members] = d[:, 0]
            continue
        poles, vectors = np.linalg.eig(a)
        into = np.linalg.solve(vectors, b.astype(np.complex128))[:, :, 0] if _sound(vectors).all() else None
        if into is None:
            identity = np.eye(order)
            for row, member in enumerate(members):
                state = np.linalg.solve(
                    s[:, None, None] * identity - a[row], np.broadcast_to(b[row], (len(s), order, 1))
                )
                result[member] = (c[row] @ state)[:, 0, 0] + d[row, 0, 0]
            continue
        residues = (c @ vectors)[:, 0] * into
        total = np.zeros((len(members), len(s)), dtype=np.complex128)
        for state in range(order):
            total += residues[:, state, None] / (s - poles[:, state, None])
        result[members] = total + d[:, 0]
    return result


def _sound(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.cond(vectors) < _DEFECTIVE
