"""A weight that covers given plants, between the points of their grid too."""

from collections.abc import Callable
from typing import Any

import control as ct
import numpy as np
from jaxtyping import Bool, Complex128, Float64

from estimators.uncertainty.plant_set import PlantSet, evaluate
from estimators.uncertainty.uncertainty_structures import Kind, errors
from estimators.uncertainty.weight import Minimise, Shape, fit_weight, lift

Curve = Float64[np.ndarray, " frequency"]

_DENSE = 10  # points between two of the grid, at which the weight is checked
_FEWEST = 200  # points to which a coarse grid is filled up for the fit of the weight
_NEAR = 0.05  # logarithm of weight over profile, below which the neighbourhood is looked at more closely
_CLOSER = 20  # points between two of the dense grid there
# Places about a mode, in half-widths of its peak, at which the weight is checked besides.
_WIDTHS = np.linspace(-4, 4, 33)
_FLOOR = 1e-6  # of the largest model error: a profile that touches zero has no logarithm
_CLEAR = 1e-6  # by which the weight clears the model errors, for what lies between even the closest points
_EQUAL = 1e-9  # of the plant, below which model errors are rounding


def cover(
    found: PlantSet, held: Bool[np.ndarray, " condition"], model: ct.TransferFunction, kind: Kind, order: int,
    minimise: Minimise, done: Callable[[], object],
) -> tuple[Shape, float, Curve]:  # fmt: skip
    """Return the weight, the factor by which those held out raised it, and the profile on the grid without zeros."""
    between = max(_DENSE, -(-2 * _FEWEST // (len(found.omega) - 1)))
    dense = _filled(found.omega, between)
    fitting = dense[:: max(1, len(dense) // max(_FEWEST, len(found.omega)))]
    within = ~held
    dense = _with_modes(dense, found, model)
    target = _profile(found, within, model, kind, dense)
    whole = float(np.abs(found.plants).max()) if kind == "additive" else 1.0
    if target.max() < _EQUAL * whole:
        raise ValueError("responses: all conditions equal the nominal model, so there is nothing to cover.")
    floor = _FLOOR * float(target.max())
    target = np.maximum(target, floor)
    wanted = np.interp(np.log(fitting), np.log(dense), target)
    shape = fit_weight(fitting, wanted, order=order, minimise=minimise, done=done)
    shape = lift(shape, max(0.0, _shortfall(found, within, model, kind, shape, dense, floor)))
    up = max(0.0, _shortfall(found, held, model, kind, shape, dense, floor)) if held.any() else 0.0
    shape = lift(shape, up)
    profile = np.maximum(_profile(found, np.ones(len(held), dtype=bool), model, kind, found.omega), floor)
    return shape, float(np.exp(up)), profile


def needed(
    found: PlantSet, model: ct.TransferFunction, weight: ct.TransferFunction, kind: Kind
) -> Float64[np.ndarray, " condition"]:
    """Return the largest |Delta| that each plant needs: on the grid, and of parametric plants between its points, too."""

    def at(
        plants: Complex128[np.ndarray, "condition frequency"], omega: Curve
    ) -> Float64[np.ndarray, "condition frequency"]:
        return np.abs(errors(plants, evaluate([model], omega)[0], kind)) / np.abs(evaluate([weight], omega)[0])

    on_grid = np.max(at(found.plants, found.omega), axis=1)
    if found.systems is None:
        return on_grid
    dense = _filled(found.omega, _DENSE)
    for i, system in enumerate(found.systems):
        omega = _with_modes(dense, found._replace(systems=(system, weight)), model)
        size = at(evaluate([system], omega), omega)[0]
        worst = int(np.argmax(size))
        closer = np.geomspace(omega[max(worst - 1, 0)], omega[min(worst + 1, len(omega) - 1)], 2 * _CLOSER)
        on_grid[i] = max(on_grid[i], size[worst], float(np.max(at(evaluate([system], closer), closer))))
    return on_grid


def _shortfall(
    found: PlantSet, which: Bool[np.ndarray, " condition"], model: ct.TransferFunction, kind: Kind, shape: Shape,
    dense: Curve, floor: float,
) -> float:  # fmt: skip
    """Return the logarithm of the factor that lifts the weight above the model errors of some plants.

    Points are closer where the weight is near.
    """
    model_errors = np.maximum(_profile(found, which, model, kind, dense), floor)
    margin = shape.log_magnitude(dense) - np.log(model_errors)
    worst = float(np.max(-margin))
    near = np.flatnonzero(np.minimum(margin[1:], margin[:-1]) < margin.min() + _NEAR)
    steps = np.linspace(np.log(dense[near]), np.log(dense[near + 1]), _CLOSER, axis=1).ravel()
    closer = np.exp(steps)
    model_errors = np.maximum(_profile(found, which, model, kind, closer), floor)
    return max(worst, float(np.max(np.log(model_errors) - shape.log_magnitude(closer)))) + _CLEAR


def _filled(omega: Curve, between: int) -> Float64[np.ndarray, " dense"]:
    """Return the grid with so many steps, equal on a log scale, in place of each of its own; its own points stay."""
    steps = np.linspace(np.log(omega[:-1]), np.log(omega[1:]), between, endpoint=False, axis=1)
    dense = np.exp(np.append(steps.ravel(), np.log(omega[-1])))
    dense[::between] = omega
    return dense


def _with_modes(dense: Curve, found: PlantSet, model: ct.TransferFunction) -> Float64[np.ndarray, " denser"]:
    """Return the grid with points about the plants' poles and the model's roots: peaks may be narrower than its steps."""
    roots = [np.roots(np.ravel(model.num[0][0])), *(_poles(one) for one in (model, *(found.systems or ())))]
    every = np.concatenate(roots).astype(np.complex128)
    about = (np.abs(every.imag)[:, None] + np.abs(every.real)[:, None] * _WIDTHS).ravel()
    return np.union1d(dense, about[(about > dense[0]) & (about < dense[-1])])


def _poles(system: ct.TransferFunction | ct.StateSpace) -> Any:
    """Return the poles; of a transfer function the roots of its denominator, whatever its numerator."""
    return np.roots(np.ravel(system.den[0][0])) if isinstance(system, ct.TransferFunction) else system.poles()


def _profile(
    found: PlantSet, which: Bool[np.ndarray, " condition"], model: ct.TransferFunction, kind: Kind, at: Curve
) -> Curve:
    if found.systems is not None:
        chosen = [system for system, wanted in zip(found.systems, which, strict=True) if wanted]
        return np.abs(errors(evaluate(chosen, at), evaluate([model], at)[0], kind)).max(axis=0)
    model_errors = np.abs(errors(found.plants[which], evaluate([model], found.omega)[0], kind)).max(axis=0)
    tiny = _FLOOR * max(float(model_errors.max()), 1e-300)
    return np.exp(np.interp(np.log(at), np.log(found.omega), np.log(np.maximum(model_errors, tiny))))
