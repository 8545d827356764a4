"""A controller in the loop with the nonlinear model: many plants in one compiled call."""

from typing import Any, NamedTuple

import control as ct
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import expm

from rtac_jax._numbers import State
from rtac_jax._rtac import RTAC
from rtac_jax.configuration import require_configured
from rtac_jax.control._checks import state_space
from rtac_jax.control._response import ClosedLoop
from rtac_jax.control._units import Actuation, Units
from rtac_jax.effects import Input
from rtac_jax.equations import sensor_outputs, state_at_start
from rtac_jax.excitation import Excitation
from rtac_jax.programs import program
from rtac_jax.simulation import advance, substeps_for

_FINE = 5e-4  # s, step of a continuous controller


class _Loop(eqx.Module):
    """The constants of one step of the loop; arrays have one element per plant or one for all.

    The controller is z' = a z + b y, u = c z + d y with its own states z + lead y.
    """

    model: RTAC
    a: Float[Array, "state state"]
    b: Float[Array, " state"]
    c: Float[Array, " state"]
    d: Float[Array, ""]
    lead: Float[Array, " state"]
    position: Float[Array, ""]
    torque: Float[Array, ""]
    torque_constant: Float[Array, "*#plant"]
    controller_limit: Float[Array, ""]
    motor_limit: Float[Array, ""]
    dead_band: Float[Array, ""]
    arm_stiffness: Float[Array, ""]
    ramps: bool = eqx.field(static=True)

    def measured(self, plant: State, noise: Float[Array, "2 plant"]) -> tuple[Any, Any]:
        """Return the cart position in the controller's units, and the arm angle [rad]."""
        shown = sensor_outputs(self.model, plant)
        return self.position * (shown.cart_position + noise[0]), shown.arm_angle + noise[1]

    def respond(self, own: Array, plant: State, noise: Float[Array, "2 plant"]) -> tuple[Array, Array]:
        """Return the torque [N m] that the sensors' readings call for, and the controller's next states."""
        error, angle = self.measured(plant, noise)
        cosine = jnp.cos(angle)
        dead = jnp.abs(cosine) <= self.dead_band
        along = -(jnp.tensordot(self.c, own, 1) + self.d * error) / self.torque
        push = jnp.clip(along / jnp.where(dead, 1.0, cosine), -self.controller_limit, self.controller_limit)
        whole = jnp.clip(push - self.arm_stiffness * angle, -self.motor_limit, self.motor_limit)
        return jnp.where(dead, 0.0, whole), jnp.tensordot(self.a, own, 1) + self.b[:, None] * error


class _Carry(NamedTuple):
    plant: tuple[Any, ...]
    own: Array
    before: Array  # torque of the last step


def closed_loop(
    model: RTAC,
    controller: ct.StateSpace | ct.TransferFunction | None,
    *,
    units: Units | None = None,
    actuation: Actuation | None = None,
    displacement: float | Float[np.ndarray, " plant"] = 0.015,
    arm_angle: float | Float[np.ndarray, " plant"] = 0.0,
    force: Float[np.ndarray, " sample"] | None = None,
    duration: float = 8.0,
    sample_time: float = 0.005,
    torque_constant: float | None = None,
    position_noise: float = 0.0,
    angle_noise: float = 0.0,
    seed: int = 0,
    substeps: int | None = None,
) -> ClosedLoop:
    """Release the cart from rest under a controller that sees its position and turns the arm.

    The motion is that of the package's one time loop: all effects of the model, and exact dry friction. A discrete
    controller acts at each sample and holds its torque. A continuous one is followed in steps of at most 0.5 ms, exact
    for a position that runs straight within a step, and its torque runs on as it did in the step before.

    Args:
        model: the nonlinear plant; parameters with one value for each plant make a batch of plants.
        controller: C of the negative feedback u = -C xi; continuous, or discrete with this sample time; None is open loop,
            in which the motor gives no torque at all.
        units: in which the controller counts position and torque; by default the nondimensional ones of the model, which
            must then be a single plant.
        actuation: how the controller's output becomes torque; by default as in the paper.
        displacement: of the cart at the start [m], for all plants or each.
        arm_angle: at the start [rad], for all plants or each.
        force: disturbance on the cart [N], held over each sample; if given it sets the duration.
        duration: [s].
        sample_time: of a discrete controller, of the noise and of what is returned [s].
        torque_constant: with which the drive turns torque into current [N m/A]; by default each plant's own.
        position_noise: standard deviation of white noise on the cart position, held over each sample [m].
        angle_noise: standard deviation of white noise on the arm angle, held over each sample [rad].
        seed: of the noise.
        substeps: Runge-Kutta steps for each step of the controller; by default as the plant's fastest mode asks.

    Returns:
        Trajectories and their metrics, one column per plant.

    Raises:
        ValueError: an argument is not finite or has the wrong sign or length, the controller is not one-to-one, not
            finite, or was made for another sample time, or the model delays or holds recorded inputs.
        RuntimeError: `configure()` was not called.
    """
    require_configured()
    _check(
        positive={"duration": duration, "sample_time": sample_time},
        others={"position_noise": position_noise, "angle_noise": angle_noise},
    )
    stages = [effect.id for effect in model.effects if isinstance(effect, Input)]
    if stages:
        raise ValueError(
            f"{stages[0]} acts on recorded inputs as a whole, which a loop has not; take it out of the model."
        )
    acting = actuation if actuation is not None else Actuation()
    if controller is None:
        scale, acting = Units.si(), Actuation(arm_stiffness=0.0)
    else:
        scale = units if units is not None else Units.nondimensional(model)
    plants = _plants(model, displacement, arm_angle)
    samples = round(duration / sample_time) + 1 if force is None else len(force)
    push = np.zeros(samples) if force is None else np.asarray(force, dtype=float)
    if not (np.all(np.isfinite(push)) and np.all(np.isfinite(displacement)) and np.all(np.isfinite(arm_angle))):
        raise ValueError("force, displacement and arm_angle must be finite; one of them is not.")
    matrices, inner = _matrices(controller, sample_time)
    constant = model["torque_constant"] if torque_constant is None else torque_constant
    loop = _Loop(
        model, *(jnp.asarray(x) for x in (*matrices, scale.position, scale.torque)),
        torque_constant=jnp.asarray(constant, dtype=float), controller_limit=jnp.asarray(float(acting.controller_limit)),
        motor_limit=jnp.asarray(float(acting.motor_limit)), dead_band=jnp.asarray(float(acting.dead_band)),
        arm_stiffness=jnp.asarray(float(acting.arm_stiffness)), ramps=inner > 1,
    )  # fmt: skip
    clock = Excitation(None, None, jnp.full(plants, sample_time / inner), jnp.ones(plants), jnp.ones(plants))
    steps = substeps if substeps is not None else substeps_for(model, clock, stability=0.5)
    random = np.random.default_rng(seed)
    noise = random.standard_normal((samples, 2, plants)) * np.array([position_noise, angle_noise])[:, None]
    start = np.zeros((4, plants))
    start[0], start[2] = displacement, arm_angle
    counts = jnp.asarray([inner, steps])
    rows = np.asarray(_run(loop, jnp.asarray(start), jnp.asarray(push), jnp.asarray(noise), clock, counts))
    return ClosedLoop(
        sample_time * np.arange(samples), *np.moveaxis(rows, 1, 0), torque_limit=float(acting.motor_limit)
    )  # fmt: skip


@program
def _run(
    loop: _Loop,
    start: Float[Array, "4 plant"],
    force: Float[Array, " sample"],
    noise: Float[Array, "sample 2 plant"],
    clock: Excitation,
    counts: Array,
) -> Float[Array, "sample 4 plant"]:
    shape = start.shape[1:]
    inner, substeps = counts

    def one_sample(carry: _Carry, row: tuple[Array, Array]) -> tuple[_Carry, Array]:
        push, wrong = row
        torque, _ = loop.respond(carry.own, carry.plant, wrong)
        shown = jnp.stack([carry.plant[0], carry.plant[2], carry.plant[3], torque])

        def one_step(_: Array, at: _Carry) -> _Carry:
            now, following = loop.respond(at.own, at.plant, wrong)
            current = (now, now - at.before) if loop.ramps else (now,)
            driven = tuple(part / loop.torque_constant for part in current)
            plant = advance(loop.model, at.plant, driven, (push,), clock, substeps=substeps)
            return _Carry(plant, following, now)

        return jax.lax.fori_loop(0, inner, one_step, carry), shown

    plant = tuple(jnp.broadcast_to(x, shape) for x in state_at_start(loop.model, tuple(start), jnp.zeros(shape)))
    rest = -loop.lead[:, None] * loop.measured(plant, noise[0])[0]
    first, _ = loop.respond(rest, plant, noise[0])
    return jax.lax.scan(one_sample, _Carry(plant, rest, first), (force, noise))[1]


def _matrices(
    controller: ct.StateSpace | ct.TransferFunction | None, sample_time: float
) -> tuple[tuple[np.ndarray, ...], int]:
    """Return a, b, c, d and lead of the controller as a recursion, and its steps in each sample."""
    if controller is None:
        return (np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(()), np.zeros(0)), 1
    if not isinstance(controller, (ct.StateSpace, ct.TransferFunction)):
        raise ValueError(
            f"controller is a {type(controller).__name__}; give a StateSpace or TransferFunction, or None."
        )
    if (controller.ninputs, controller.noutputs) != (1, 1):
        raise ValueError("the controller must have one input, the cart position, and one output, the torque.")
    found = state_space(controller)
    a, b, c, d = (np.array(x, dtype=float) for x in (found.A, found.B, found.C, found.D))
    if not all(np.all(np.isfinite(x)) for x in (a, b, c, d)):
        raise ValueError("the controller has coefficients that are not finite.")
    inner, lead = 1, np.zeros((len(a), 1))
    if not found.dt:
        inner = max(int(np.ceil(sample_time / _FINE - 1e-9)), 2)
        a, b, c, d, lead = _first_order_hold(a, b, c, d, sample_time / inner)
    elif not np.isclose(float(found.dt), sample_time, rtol=1e-9):
        raise ValueError(
            f"the controller was made for a sample time of {float(found.dt):g} s, but the loop runs at {sample_time:g} s; "
            "discretise it for the loop's sample time."
        )
    return tuple(np.asarray(x) for x in (a, b[:, 0], c[0], d[0, 0], lead[:, 0])), inner


def _first_order_hold(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, step: float
) -> tuple[np.ndarray, ...]:
    """Discretise state-space matrices, exactly for an input that runs straight within each step.

    SciPy's `cont2discrete` gives the same matrices, but not `lead`, without which the states cannot start at rest.

    Source: Franklin, Powell and Workman, Digital Control of Dynamic Systems (1998), section 6.3.2.
    """
    count = len(a)
    block = np.zeros((count + 2, count + 2))
    block[:count, :count], block[:count, count], block[count, count + 1] = step * a, step * b[:, 0], 1.0
    found = expm(block)
    onwards, held, lead = found[:count, :count], found[:count, count : count + 1], found[:count, count + 1 :]
    return onwards, held - lead + onwards @ lead, c, d + c @ lead, lead


def _check(*, positive: dict[str, float], others: dict[str, float]) -> None:
    for name, value in (positive | others).items():
        if not np.isfinite(value) or value < 0 or (name in positive and value == 0):
            kind = "positive" if name in positive else "zero or positive"
            raise ValueError(f"{name} is {value}, but must be {kind} and finite.")


def _plants(model: RTAC, displacement: float | np.ndarray, arm_angle: float | np.ndarray) -> int:
    """Return the number of plants that run side by side."""
    shapes = {name: np.shape(model[name]) for name in model.parameters}
    shapes |= {"displacement": np.shape(displacement), "arm_angle": np.shape(arm_angle)}
    several = {name: shape for name, shape in shapes.items() if shape not in {(), (1,)}}
    if any(len(shape) != 1 for shape in several.values()) or len(set(several.values())) > 1:
        found = ", ".join(f"{name} has shape {shape}" for name, shape in several.items())
        raise ValueError(f"give every plant one value of each parameter: {found}.")
    return next(iter(several.values()))[0] if several else 1
