"""Linearisation of the model about an operating point, and equation (4) in closed form."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import control as ct
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import root

from rtac_jax._rtac import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.configuration import require_configured
from rtac_jax.effect_contract import require_working_model
from rtac_jax.equations import dead_time, derivative, sensor_outputs
from rtac_jax.programs import program

OUTPUTS = ("cart_position", "arm_velocity", "arm_angle")
_NUDGE = 1e-12  # small against any velocity of interest, so that its square vanishes
_REST = 1e-9  # accelerations [m/s^2, rad/s^2] below which a state counts as an equilibrium


@checked_arguments
def linearise(
    model: RTAC,
    *,
    arm_angle: float = 0.0,
    drive: Literal["torque", "current"] = "torque",
    delay_order: int = 3,
) -> ct.StateSpace:
    """Return the linear system for small motions about the equilibrium with the arm at this angle.

    The Jacobian is that of the model's own derivative, exact, so every effect with its states takes part. A dead time of the
    current, which no linear system of finite order has, is Pade's approximation, whose phase is off by less than a hundredth of
    a radian up to the frequency 2.5 over the dead time at order 3. How the current runs between samples is no part of it.
    Where gravity, cogging or an offset acts, the equilibrium's cart position and holding current are found first, and states,
    input and outputs are deviations from them. Dry friction has no linearisation, because its force jumps at rest: it is
    left out, so the linear system is that of a rig with no dry friction and is damped less than the rig. Where a force has a
    kink at rest (the arm's friction, which differs by direction), the slope is the mean of both sides.

    Args:
        model: with one value of each parameter.
        arm_angle: at the equilibrium [rad].
        drive: the first input is the motor's torque [N m] or its current [A], as commanded.
        delay_order: of the approximation of a dead time; 0 leaves the dead time out.

    Returns:
        Inputs `torque` or `current` and `disturbance_force` [N], outputs `cart_position` [m], `arm_velocity` [rad/s] and
        `arm_angle` [rad] as the sensors show them, states named as the model's,
        and those of the dead time.

    Raises:
        ValueError: the angle is not finite, the order negative, a parameter has several values, or there is no equilibrium at
            this angle.
        RuntimeError: `configure()` was not called.

    Source: Golub and Van Loan, Matrix Computations (2013), section 9.3, for Pade's approximation of exp.
    """
    require_configured()
    require_working_model(model)
    if not np.isfinite(arm_angle):
        raise ValueError(f"arm_angle is {arm_angle}; give a finite angle in radians.")
    if delay_order < 0:
        raise ValueError(f"delay_order is {delay_order}; give a whole number from 0 on.")
    if drive not in ("torque", "current"):
        raise ValueError(f"drive is {drive!r}; choose 'torque' or 'current'.")
    several = [name for name in model.parameters if np.ndim(model[name])]
    if several:
        raise ValueError(f"{several[0]} has {np.size(model[several[0]])} values; linearise one plant at a time.")
    rest, holding = _equilibrium(model, arm_angle)
    a, b, c = _both_sides(lambda at, inputs: _jacobians(model, at, inputs), rest, holding)
    if drive == "torque":
        b = b / np.array([float(model["torque_constant"]), 1.0])
    states = [name.replace(".", "_") for name in model.states]
    if delay_order and float(dead_time(model)) > 0:
        a, b, c = _delayed(a, b, c, float(dead_time(model)), delay_order)
        states += [f"dead_time_{number + 1}" for number in range(delay_order)]
    return ct.StateSpace(
        a, b, c, np.zeros((len(OUTPUTS), 2)), states=states,
        inputs=[drive, "disturbance_force"], outputs=list(OUTPUTS), name="rtac",
    )  # fmt: skip


def _delayed(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, dead_time: float, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the system whose first input comes later by a dead time."""
    # Of a dead time of one, whose coefficients are moderate; the states of any other run faster or slower.
    unit = ct.ss(ct.tf(*ct.pade(1.0, order)))
    within, fed = np.asarray(unit.A) / dead_time, np.asarray(unit.B) / dead_time
    late, at_once = b[:, :1] @ np.asarray(unit.C), b[:, :1] * float(unit.D[0, 0])
    none = np.zeros((order, len(a)))
    return (
        np.block([[a, late], [none, within]]),
        np.block([[at_once, b[:, 1:]], [fed, np.zeros((order, b.shape[1] - 1))]]),
        np.hstack([c, np.zeros((len(c), order))]),
    )


def linear_matrices(
    model: RTAC, values: Mapping[str, Float[np.ndarray, " plant"]]
) -> tuple[
    Float[np.ndarray, "plant state state"], Float[np.ndarray, "plant state 2"], Float[np.ndarray, "plant 3 state"]
]:
    """Return A, B and C of `linearise` at theta = 0, from the current as it flows, for many plants at once.

    All are linearised about the equilibrium of the model itself, which is theirs too where nothing pulls the rig aside.

    Args:
        model: that all plants are linearised about.
        values: of some parameters, one for each plant.

    Raises:
        ValueError: as `linearise`.
    """
    plants = model.with_values(values)
    # A parameter has one value for each plant where the model has one.
    axes = jax.tree.map(lambda one, many: 0 if np.ndim(many) > np.ndim(one) else None, model, plants)
    several = eqx.filter_vmap(_jacobians, in_axes=(axes, None, None))
    return _both_sides(lambda at, inputs: several(plants, at, inputs), *_equilibrium(model, 0.0))


def _both_sides(jacobians: Callable[[Array, Array], Any], rest: np.ndarray, holding: float) -> tuple[Any, Any, Any]:
    """Return the mean of the slopes on both sides of rest."""
    sides = []
    for side in (_NUDGE, -_NUDGE):
        at = jnp.asarray(rest).at[jnp.array([1, 3])].add(side)
        sides.append([np.asarray(part) for part in jacobians(at, jnp.array([holding, 0.0]))])
    a, b, c = (0.5 * (left + right) for left, right in zip(*sides, strict=True))
    return a, b, c


@checked_arguments
def equation_4(model: RTAC, *, arm_angle: float = 0.0, rate: float = 1.0) -> ct.TransferFunction:
    """Return equation (4): from normalised torque u to normalised cart position xi, at small motions about an arm angle.

    Only the rigid body and the cart's viscous friction enter; the arm turns without friction, as in the paper. For a plant
    in seconds that still relates the normalised u and xi, give the natural frequency, `model.body.natural_frequency()`.

    Args:
        model: of which the rigid body and the cart's viscous friction enter.
        arm_angle: theta_0 [rad].
        rate: normalised time per unit of the result's time, 1 for the paper's own.

    Raises:
        ValueError: the angle is not finite, the rate is not positive, or the model has no spring.
    """
    if not (np.isfinite(arm_angle) and np.isfinite(rate) and rate > 0):
        raise ValueError(f"arm_angle is {arm_angle} and rate is {rate}; give a finite angle and a positive rate.")
    body = model.body
    if not float(body.spring_stiffness) > 0:
        raise ValueError(
            "the model has no spring (spring_stiffness = 0), whose period is the normalised time of equation (4)."
        )
    viscous = float(model["cart_viscous.coefficient"]) if "cart_viscous" in model else 0.0
    coupling = float(body.coupling()) * np.cos(arm_angle)
    damping = viscous / float(jnp.sqrt(body.spring_stiffness * body.total_mass))
    return ct.TransferFunction(
        [coupling], [(coupling**2 - 1.0) / rate**2, -damping / rate, -1.0], inputs=["u"], outputs=["xi"]
    )


def _equilibrium(model: RTAC, arm_angle: float) -> tuple[np.ndarray, float]:
    """Return the state at rest with the arm at this angle, and the current [A] that holds it there."""
    count = len(model.states)
    moving = np.array([0, *range(4, count)])  # what rest leaves open besides the current
    residual = np.array([1, 3, *range(4, count)])

    def state(unknown: np.ndarray) -> Array:
        return jnp.zeros(count).at[2].set(arm_angle).at[moving].set(unknown[1:])

    def slope(unknown: np.ndarray) -> np.ndarray:
        return np.asarray(_derivative(model, state(unknown), jnp.array([unknown[0], 0.0])))[residual]

    guess = np.zeros(len(residual))
    if np.max(np.abs(slope(guess))) > _REST:
        guess = root(slope, guess, tol=1e-13).x
        if not np.max(np.abs(slope(guess))) < _REST:
            raise ValueError(
                f"the model has no equilibrium with the arm at {arm_angle:g} rad that a current can hold; "
                "choose another arm_angle."
            )
    return np.asarray(state(guess)), float(guess[0])


@program
def _derivative(model: RTAC, state: Float[Array, " state"], inputs: Float[Array, " input"]) -> Float[Array, " state"]:
    slopes = derivative(model, tuple(state), inputs[0], inputs[1])
    return jnp.stack([jnp.asarray(slope, dtype=float) for slope in slopes])


@program
def _jacobians(
    model: RTAC, state: Float[Array, " state"], inputs: Float[Array, " input"]
) -> tuple[Float[Array, "state state"], Float[Array, "state input"], Float[Array, "output state"]]:
    a, b = jax.jacfwd(lambda x, u: _derivative(model, x, u), argnums=(0, 1))(state, inputs)
    c = jax.jacfwd(lambda x: jnp.stack([jnp.asarray(y, dtype=float) for y in sensor_outputs(model, tuple(x))]))(state)
    return a, b, c
