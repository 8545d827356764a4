"""The two linear systems of section 4.1: free oscillation, then, with its result, forced oscillation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from estimators.closed_form.regressors import Terms
from rtac_jax import RTAC

Weighting = Literal["residual", "inertia", "none"]
System = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Regressors, what they are to explain, and the instruments: the regressors again, for plain least squares."""

RATIOS = {"total_mass": "(M+m)/k", "cart_viscous.coefficient": "v/k", "cart_coulomb.level": "d/k"}
_UNITS = {"total_mass": "s^2", "cart_viscous.coefficient": "s", "cart_coulomb.level": "m"}
# Parameter and the term of the equation that it multiplies.
CART = {
    "total_mass": "mass",
    "cart_viscous.coefficient": "viscous",
    "cart_coulomb.level": "dry",
    "spring_stiffness": "spring",
    "eccentric_moment": "swing",
}
ARM = {
    "arm_inertia": "inertia",
    "eccentric_moment": "reaction",
    "torque_constant": "current",
    "arm_viscous.positive": "positive",
    "arm_viscous.negative": "negative",
}
FORCED = ("eccentric_moment", "torque_constant", "arm_viscous.positive", "arm_viscous.negative")
OF_CART = ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level")


@dataclasses.dataclass(frozen=True)
class Estimates:
    """The estimates of one quantity, from each experiment by itself and from all together.

    Attributes:
        names: of the experiments.
        each: the estimate from each experiment.
        value: the mean of those, as in the paper's Table 1.
        std: standard deviation of that mean, from the scatter over experiments and the standard deviations of constants that
            were measured beforehand; it does not see what else shifts all of them alike. With few experiments take it with
            Student's distribution of one degree of freedom less than there are.
        pooled: the estimate from all experiments stacked.
        unit: SI unit.
    """

    names: tuple[str, ...]
    each: Float[np.ndarray, " experiment"]
    value: float
    std: float
    pooled: float
    unit: str

    @property
    def consistency(self) -> float:
        """Return the standard deviation over experiments divided by the mean; the paper trusts a model when all are below 0.3."""
        if len(self.each) < 2 or self.value == 0:
            return float("nan")
        return float(np.std(self.each, ddof=1) / abs(self.value))


def free_stage(
    model: RTAC, ready: Sequence[Terms], *, pushed: bool, reaction: bool, acceleration: bool
) -> tuple[RTAC, dict[str, Estimates], dict[str, Estimates]]:
    """Solve equation (5) for (M+m)/k, v/k and d/k; with a known disturbance force also for k.

    Args:
        model: gives the constants known beforehand.
        ready: terms of the experiments in free oscillation.
        pushed: the experiments have a known disturbance force.
        reaction: take the arm's reaction into account, with the model's me.
        acceleration: solve for the acceleration rather than for the position; what is solved for may be noisy without
            biasing the rest, and the acceleration is the noisiest.
    """
    names = [name for name in RATIOS if name in model.parameters]
    if not ready or "total_mass" not in names:
        return model, {}, {}
    moment, mass, stiffness = (_value(model, n) for n in ("eccentric_moment", "total_mass", "spring_stiffness"))

    def system(s: Terms) -> System:
        columns = {name: s.cart[CART[name]] for name in names}
        target = s.cart["force"] if pushed else -s.cart["spring"]
        if reaction and s.arm_free and s.has_arm:
            target = target - (moment if pushed else moment / stiffness) * s.cart["swing"]
        elif reaction and s.arm_free:
            # An arm without a sensor follows its equation without torque: J theta'' = -me q'' cos theta.
            lighter = moment**2 / (mass * _value(model, "arm_inertia")) * np.cos(s.angle) ** 2
            columns["total_mass"] = columns["total_mass"] * (1 - lighter)
        matrix = np.stack(list(columns.values()), axis=1)
        if pushed:
            matrix = np.column_stack([matrix, s.cart["spring"]])
        elif acceleration:
            # (M+m)/k q'' + rest = -q, divided by (M+m)/k: the unknowns are k/(M+m), v/(M+m) and d/(M+m).
            swing = s.cart["swing"] if reaction and s.arm_free and s.has_arm else 0.0
            target = -matrix[:, 0] - moment / mass * swing
            matrix = np.column_stack([s.cart["spring"], matrix[:, 1:]])
        return matrix[s.sliding], target[s.sliding], matrix[s.sliding]

    systems = [system(s) for s in ready]
    used = [i for i, (matrix, *_) in enumerate(systems) if len(matrix) >= matrix.shape[1]]
    if not used:
        return model, {}, {}
    labels = tuple(ready[i].name for i in used)
    values, pooled = solve_each([systems[i] for i in used])
    everything = np.vstack([values, pooled])
    if pushed:
        each_k, ratio = everything[:, -1], everything[:, :-1] / everything[:, -1:]
    else:
        ratio = everything
        if acceleration:
            ratio = np.column_stack([1.0 / everything[:, 0], everything[:, 1:] / everything[:, :1]])
        known = "spring_stiffness" in model.fixed and "total_mass" not in model.fixed
        each_k = np.full(len(ratio), stiffness) if known else mass / ratio[:, 0]
    ratios = {RATIOS[n]: summary(labels, ratio[:, i], _UNITS[n]) for i, n in enumerate(names)}
    estimates = {"spring_stiffness": summary(labels, each_k, "N/m")}
    for i, name in enumerate(names):
        estimates[name] = summary(labels, ratio[:, i] * each_k, model.parameters[name].unit)
    estimates = {name: found for name, found in estimates.items() if name in model.free}
    return placed(model, estimates), ratios, estimates


def forced_stage(
    model: RTAC, ready: Sequence[Terms], *, weighting: Weighting, alone: bool, instruments: bool
) -> tuple[RTAC, dict[str, Estimates]]:
    """Solve equation (6) for me, K_m, K_v1 and K_v2 from both equations of motion together.

    Args:
        model: gives the constants known beforehand and from the first stage.
        ready: terms of the experiments in forced oscillation.
        weighting: of the two equations: by their own residuals, by M+m and I+me^2 so that both are accelerations, or none.
        alone: there was no free oscillation, so k, v and d are estimated here too.
        instruments: for the arm's friction the arm's velocity of before. A random torque drives the velocity that it
            disturbs, which lets the friction look smaller.
    """
    names = [n for n in (*FORCED, *(OF_CART if alone else ())) if n in model.free]
    if not ready or not names:
        return model, {}
    value = {name: _value(model, name) for name in model.parameters}

    systems = []
    for s in ready:
        matrix, target = rows_of(s.arm, ARM, names, value, np.zeros(len(s.arm["inertia"])))
        parts = [with_earlier(matrix, target, names, s.lag if instruments else 0)]
        if tells_of_cart(s):
            matrix, target = rows_of(s.cart, CART, names, value, s.cart["force"])
            parts.insert(0, (matrix[s.sliding], target[s.sliding], matrix[s.sliding]))
        systems.append(parts)

    def stacked(weights: Mapping[int, Sequence[float]]) -> list[System]:
        result = []
        for parts in systems:
            weighted = [tuple(w * x for x in part) for w, part in zip(weights[len(parts)], parts, strict=True)]
            result.append(tuple(np.concatenate(column) for column in zip(*weighted, strict=True)))
        return result

    weights: dict[int, Sequence[float]] = {2: (1.0, 1.0), 1: (1.0,)}
    if weighting != "none":
        weights = {2: (1 / value["total_mass"], 1 / value["arm_inertia"]), 1: (1 / value["arm_inertia"],)}
    if weighting == "residual":
        _, pooled = solve_each(stacked(weights))
        for size in (1, 2):
            if of_size := [parts for parts in systems if len(parts) == size]:
                weights[size] = [
                    1.0 / max(np.sqrt(np.mean([np.mean((p[i][1] - p[i][0] @ pooled) ** 2) for p in of_size])), 1e-300)
                    for i in range(size)
                ]
    found, pooled = solve_each(stacked(weights))
    labels = tuple(s.name for s in ready)
    everything = np.vstack([found, pooled])
    estimates = {n: summary(labels, everything[:, i], model.parameters[n].unit) for i, n in enumerate(names)}
    return placed(model, estimates), estimates


def rows_of(
    terms: Mapping[str, np.ndarray],
    which: Mapping[str, str],
    names: Sequence[str],
    known: Mapping[str, float],
    target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the regressors of the named parameters in one equation, and its target less what the known ones explain."""
    matrix = np.zeros((len(target), len(names)))
    for name, term in which.items():
        column = -terms[term] if name == "torque_constant" else terms[term]
        if name in names:
            matrix[:, names.index(name)] = column
        elif name in known:
            target = target - known[name] * column
    return matrix, target


def tells_of_cart(terms: Terms) -> bool:
    """Return whether the cart's equation says anything: a cart that never slides says nothing of its motion."""
    return bool(np.any(terms.cart["spring"]) and np.any(terms.sliding))


def with_earlier(matrix: np.ndarray, target: np.ndarray, names: Sequence[str], lag: int) -> System:
    """Return a system whose instruments hold the arm's velocity of `lag` rows before, which no row integrates over."""
    instruments = matrix.copy()
    if lag == 0 or lag >= len(matrix):
        return matrix, target, instruments
    for column, name in enumerate(names):
        if name.startswith("arm_viscous."):
            instruments[lag:, column] = matrix[:-lag, column]
    return matrix[lag:], target[lag:], instruments[lag:]


def solve_each(systems: Sequence[System]) -> tuple[np.ndarray, np.ndarray]:
    """Solve each system by itself and all stacked, by least squares or instrumental variables; columns scaled to one size."""

    def solve(matrix: np.ndarray, target: np.ndarray, instruments: np.ndarray) -> np.ndarray:
        size = np.sqrt(np.mean(matrix**2, axis=0))
        size = np.where(size > 0, size, 1.0)
        if instruments is matrix or np.array_equal(instruments, matrix):
            return np.linalg.lstsq(matrix / size, target, rcond=1e-10)[0] / size
        across = (instruments / size).T
        return np.linalg.lstsq(across @ (matrix / size), across @ target, rcond=1e-10)[0] / size

    each = np.array([solve(*system) for system in systems])
    return each, solve(*(np.concatenate(parts) for parts in zip(*systems, strict=True)))


def _value(model: RTAC, name: str) -> float:
    return float(np.mean(np.asarray(model[name])))


def summary(names: tuple[str, ...], values: np.ndarray, unit: str) -> Estimates:
    """Summarise the values of each experiment and, last, of all stacked."""
    each = np.asarray(values[:-1])
    std = float(np.std(each, ddof=1) / np.sqrt(len(each))) if len(each) > 1 else float("nan")
    return Estimates(names, each, float(np.mean(each)), std, float(values[-1]), unit)


def placed(model: RTAC, estimates: Mapping[str, Estimates]) -> RTAC:
    """Return the model with these estimates, moved inside the bounds where the data put one outside."""
    values = {}
    for name, found in estimates.items():
        lower, upper = model.parameters[name].bounds
        best = found.pooled
        before = _value(model, name)
        if not np.isfinite(best) or (name in {"total_mass", "arm_inertia", "spring_stiffness"} and best <= 0):
            best = before
        values[name] = float(np.clip(best, lower if np.isfinite(lower) else -np.inf, upper))
    if values.get("eccentric_moment") == 0.0:
        values["eccentric_moment"] = 0.1 * _value(model, "eccentric_moment")
    return model.with_values(values)
