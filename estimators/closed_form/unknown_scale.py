"""The scale of one equation of motion from the other, where only one of total mass and arm inertia was measured.

Each equation alone is known but for a factor: equation (1) divided by k, equation (2) by I+me^2. The product me stands in both,
so a scale of one of them is one of both.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.closed_form.regressors import Terms
from estimators.closed_form.two_stage import (
    ARM,
    CART,
    FORCED,
    OF_CART,
    Estimates,
    System,
    placed,
    rows_of,
    solve_each,
    summary,
    tells_of_cart,
    with_earlier,
)
from rtac_jax import RTAC

_PER_INERTIA = tuple(name for name in ARM if name != "arm_inertia")
_SWING = "eccentric_moment"
SCALING = frozenset({_SWING, "torque_constant"})
"""Of which either tells the scale of the arm's equation, where it is known."""


def unknown_scales(model: RTAC, *, pushed: bool) -> tuple[str, ...]:
    """Return which of total mass and arm inertia were not measured, where neither a force nor the stiffness tells the mass.

    Args:
        model: with what was measured fixed.
        pushed: a disturbance force is known.
    """
    told = {"total_mass"} if pushed or "spring_stiffness" in model.fixed else set()
    return tuple(name for name in ("total_mass", "arm_inertia") if name in model.free and name not in told)


def scale_stage(
    model: RTAC,
    ready: Sequence[Terms],
    estimates: Mapping[str, Estimates],
    *,
    unknown: str,
    alone: bool,
    instruments: bool,
) -> tuple[RTAC, dict[str, Estimates]]:
    """Solve equation (6) where the total mass or the arm inertia is unknown: me from one equation is the scale of the other.

    Where me or K_m is fixed, that is the scale of the arm's equation.

    Args:
        model: gives the constants known beforehand, and from the first stage the ratios of the cart's equation.
        ready: terms of the experiments in forced oscillation; those in which the cart never slides are left out.
        estimates: of the first stage, of a stiffness that it had to assume where the total mass is unknown.
        unknown: "total_mass" or "arm_inertia".
        alone: there was no free oscillation.
        instruments: for the arm's friction the arm's velocity of before; see `forced_stage`.
    """
    told = [s for s in ready if tells_of_cart(s)]
    # Where K_m is known the arm's equation has its scale, whether or not anything is seen of the cart; me shows by its motion.
    scaling = (_SWING, "torque_constant") if told else ("torque_constant",)
    known = next((n for n in scaling if n in model.fixed), None) if unknown == "arm_inertia" else None
    ready = told if told or known is None else ready
    names = [n for n in (*FORCED, *OF_CART, unknown) if n in model.free]
    if not ready or not names:
        return model, {}
    value = {name: float(np.mean(np.asarray(model[name]))) for name in model.parameters}
    arm, cart = (_arm_alone, _cart_alone) if unknown == "arm_inertia" else (_arm, _cart_per_stiffness)
    of_arm = _solved([arm(s, model, value, s.lag if instruments else 0) for s in ready])
    of_cart = _solved([cart(s, model, value, alone) for s in told])
    if unknown == "arm_inertia":
        scale = np.full(len(of_arm[known]), value[known]) if known else of_cart[_SWING]
        found = _with_inertia(of_arm, of_cart, known or _SWING, scale)
    else:
        found = _with_stiffness(of_arm, of_cart, value)
    labels = tuple(s.name for s in ready)
    made = {n: summary(labels, found[n], model.parameters[n].unit) for n in names if n in found}
    if not made[unknown].pooled > 0:  # noise, as of an arm that hardly moves the cart: it tells no scale
        return model, {}
    if unknown == "total_mass" and not alone:
        made |= {
            n: _with_ratio(made[n], estimates[n]) for n in (*OF_CART, "total_mass") if n in made and n in estimates
        }
    return placed(model, made), made


def _with_ratio(scaled: Estimates, ratio: Estimates) -> Estimates:
    """Return an estimate by a scale, with the relative deviation of the ratio that was scaled."""
    relative = ratio.std / abs(ratio.value) if ratio.value else 0.0
    return dataclasses.replace(scaled, std=float(np.hypot(scaled.std, relative * scaled.value)))


Solved = dict[str, np.ndarray]
"""The solution for each experiment by itself and, last, for all stacked; by name."""


def _solved(systems: Sequence[tuple[System, Sequence[str]]]) -> Solved:
    if not systems or not systems[0][1]:
        return {}
    each, pooled = solve_each([system for system, _ in systems])
    return dict(zip(systems[0][1], np.vstack([each, pooled]).T, strict=True))


def _arm_alone(s: Terms, model: RTAC, value: Mapping[str, float], lag: int) -> tuple[System, Sequence[str]]:
    """Return the arm's equation divided by its inertia, all else unknown.

    It shows me by the cart's acceleration, which is noise where the cart tells nothing.
    """
    names = [n for n in _PER_INERTIA if n in model.parameters and (n != _SWING or tells_of_cart(s))]
    matrix, target = rows_of(s.arm, ARM, names, {"arm_inertia": 1.0}, np.zeros(len(s.arm["inertia"])))
    return with_earlier(matrix, target, names, lag), names


def _arm(s: Terms, model: RTAC, value: Mapping[str, float], lag: int) -> tuple[System, Sequence[str]]:
    """Return the arm's equation, its inertia known."""
    names = [n for n in _PER_INERTIA if n in model.free]
    matrix, target = rows_of(s.arm, ARM, names, value, np.zeros(len(s.arm["inertia"])))
    return with_earlier(matrix, target, names, lag), names


def _cart_alone(s: Terms, model: RTAC, value: Mapping[str, float], alone: bool) -> tuple[System, Sequence[str]]:
    """Return the cart's equation, its mass known."""
    names = [n for n in (_SWING, *(OF_CART if alone else ())) if n in model.free]
    matrix, target = rows_of(s.cart, CART, names, value, s.cart["force"])
    return (matrix[s.sliding], target[s.sliding], matrix[s.sliding]), names


def _cart_per_stiffness(s: Terms, model: RTAC, value: Mapping[str, float], alone: bool) -> tuple[System, Sequence[str]]:
    """Return the cart's equation divided by its stiffness; its ratios are known unless there was no free oscillation."""
    ratios = {n: value[n] / value["spring_stiffness"] for n in CART if n in value and n != _SWING}
    names = [_SWING, *(n for n in CART if alone and n in ratios and n != "spring_stiffness")]
    matrix, target = rows_of(s.cart, CART, names, ratios, np.zeros(len(s.cart["spring"])))
    return (matrix[s.sliding], target[s.sliding], matrix[s.sliding]), names


def _with_inertia(of_arm: Solved, of_cart: Solved, known: str, scale: np.ndarray) -> Solved:
    """Return the arm's parameters from those divided by its inertia, of which one is known."""
    inertia = scale / of_arm[known]
    return of_cart | {name: inertia * per for name, per in of_arm.items()} | {"arm_inertia": inertia}


def _with_stiffness(of_arm: Solved, of_cart: Solved, value: Mapping[str, float]) -> Solved:
    moment = of_arm.get(_SWING, np.full(len(of_cart[_SWING]), value[_SWING]))
    stiffness = moment / of_cart[_SWING]
    ratios = {n: np.full(len(stiffness), value[n] / value["spring_stiffness"]) for n in CART if n in value}
    ratios |= {name: per for name, per in of_cart.items() if name != _SWING}
    return of_arm | {n: stiffness * r for n, r in ratios.items() if n != _SWING} | {_SWING: moment}
