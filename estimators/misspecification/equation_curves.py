"""The force missing from the equations of motion as a function of one variable, where no predictor tells what is missing."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from estimators.closed_form.motion_regression import MotionRegression, motion_regression
from estimators.closed_form.static_regressors import Added
from estimators.core.initial_state import scales_of
from estimators.misspecification.static_force import SLOW, ForceCurve, curve_of, places_of
from estimators.prediction_error.force_probe import KNOTS
from rtac_jax import RTAC
from rtac_jax.effects.spline_force import PORTS, VARIABLES
from rtac_jax.measurement import Experiment

_PARTS = 4  # stretches of an experiment, over which what a curve explains has to be alike


class EquationCurve(NamedTuple):
    """A force that would explain an equation of motion.

    Attributes:
        curve: the force.
        values: estimates of the model's parameters beside it, by name, SI units.
        fraction: of the squared error of its port's equation, that it explains.
    """

    curve: ForceCurve
    values: Mapping[str, float]
    fraction: float


def equation_curves(model: RTAC, experiments: Sequence[Experiment], levels: Mapping[str, float]) -> list[EquationCurve]:
    """Return the force at each port against each variable that explains its equation best, the best first.

    A filter whose random forces stand in for the physics predicts well whatever is missing; the equations of motion along what
    was measured have no such forces. Empty where the motion does not tell them.

    Args:
        model: that lacks something.
        experiments: that move.
        levels: noise of each channel, SI units.

    Source: Messenger and Bortz, SIAM Multiscale Model. Simul. 19 (2021), for unknown terms of equations in their weak form.
    """
    equations = motion_regression(model, experiments, levels)
    if equations is None:
        return []
    moves, scales = _moves(equations), scales_of(model, experiments)
    ranges = {name: _between(values) for name, values in moves.items()}
    slow = (SLOW * scales.velocity, SLOW * scales.arm_velocity)
    found = [_curve(equations, port, variable, moves, ranges, slow[port]) for port, variable in places_of(ranges)]
    return sorted((one for one in found if one is not None), key=lambda one: -one.curve.score)


def _moves(equations: MotionRegression) -> dict[str, Float[np.ndarray, " sample"]]:
    """Return what a force may depend on, along the measured motion; the arm's angle within a turn."""
    motion = equations.motion
    turns = np.asarray(motion.arm_angle) / (2 * np.pi)
    named = {
        "cart_position": motion.cart_position,
        "cart_velocity": motion.cart_velocity,
        "arm_angle": 2 * np.pi * (turns - np.floor(turns + 0.5)),
        "arm_velocity": motion.arm_velocity,
        "current": motion.current,
    }
    return {name: np.asarray(values, dtype=float) for name, values in named.items()}


def _between(values: Float[np.ndarray, " sample"]) -> tuple[float, float]:
    low, high = np.quantile(values, [0.001, 0.999])
    return float(low), float(high)


def _curve(
    equations: MotionRegression,
    port: int,
    variable: int,
    moves: Mapping[str, Float[np.ndarray, " sample"]],
    ranges: Mapping[str, tuple[float, float]],
    slow: float,
) -> EquationCurve | None:
    """Return the force at a port against a variable; None where its equation has too few rows, or shows nothing of it."""
    name = VARIABLES[variable].split(",")[0]
    low, high = ranges[name]
    at = np.linspace(low, high, KNOTS)
    place = np.clip((moves[name] - low) / (high - low) * (KNOTS - 1), 0.0, KNOTS - 1.0)
    hats = np.maximum(0.0, 1.0 - np.abs(place - np.arange(KNOTS)[:, None]))
    if "," in VARIABLES[variable]:
        speed = moves["cart_velocity" if port == 0 else "arm_velocity"]
        hats = -hats * speed / np.sqrt(speed**2 + slow**2)
    nothing = np.zeros_like(place)
    of_port = equations.on_arm == bool(port)
    independent, count = float(equations.independent[port]), int(np.sum(of_port))
    if independent <= 2 * KNOTS:
        return None
    added = [Added(nothing, hat) if port else Added(hat, nothing) for hat in hats]
    rows = np.stack([equations.rows_of(one)[of_port] for one in added], axis=1)
    columns = equations.columns[of_port]
    told = np.linalg.norm(columns, axis=0) > 0
    columns = columns[:, told]
    basis = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0] if told.any() else np.zeros((count, 0))
    target = equations.target[of_port]
    error = target - basis @ (basis.T @ target)
    beside = rows - basis @ (basis.T @ rows)
    heights = np.linalg.lstsq(beside, -error, rcond=1e-6)[0]
    whole = float(error @ error)
    left = float(np.sum((error + beside @ heights) ** 2)) + max(float(equations.floor[port]), 1e-300)
    if not whole > left:
        return None
    # Rows that share samples count as one, and what nothing explains is the noise.
    unit = np.sqrt(left / independent)
    blocks = equations.stretches(_PARTS)[of_port]
    edges = [0, *(np.flatnonzero(np.diff(blocks)) + 1).tolist(), count]
    folds = [slice(begin, end) for begin, end in itertools.pairwise(edges)]
    curve = curve_of(
        PORTS[port], VARIABLES[variable], at, rows / unit, error / unit, basis, blocks, folds=folds, slow=slow,
        count=int(independent),
    )  # fmt: skip
    if curve is None:
        return None
    force = curve.amounts @ curve.shapes
    values = dict(equations.solved().values)
    if told.any():
        names = np.array(equations.names)[told]
        own = np.linalg.lstsq(columns, target + rows @ force, rcond=1e-10)[0]
        values |= {str(n): float(value) for n, value in zip(names, own, strict=True)}
    return EquationCurve(curve, values, 1.0 - left / whole)
