"""Mixed sensitivity synthesis (9), with every result checked on the closed loop itself."""

import dataclasses

import control as ct
import numpy as np
from jaxtyping import Complex, Float
from slycot import sb10fd
from slycot.exceptions import SlycotError

from rtac_jax.control._checks import (
    InfeasibleError,
    Linear,
    finite_response,
    is_stable,
    plant_of,
    poles_of,
    state_space,
    zeros_of,
)
from rtac_jax.control._weights import Weights

_LARGEST = 1e4  # gamma beyond which a problem counts as unsolvable
_DIGITS = 1e-4  # to which the smallest gamma is found
_HONEST = 1e-3  # by how much the norm of a closed loop may exceed what the solver was asked for
_FREQUENCIES = 1000


@dataclasses.dataclass(frozen=True)
class Synthesis:
    """A controller C for u = -C y and what it achieves with the nominal plant.

    Attributes:
        controller: C, in the nominal plant's units.
        gamma: the norm (9) of its closed loop, computed from that closed loop.
        optimum: the smallest gamma that was reached; `gamma` is larger by the `relax` that was asked for, or less.
        bound: no controller has a smaller gamma, because S + T = 1; reached at `bound_frequency` [rad/s].
        nominal: P_0.
        weights: of the problem.
        frequency: [rad/s].
        sensitivity, complementary, effort: S, T and C S over frequency.
    """

    controller: ct.StateSpace
    gamma: float
    optimum: float
    bound: float
    bound_frequency: float
    nominal: ct.StateSpace
    weights: Weights
    frequency: Float[np.ndarray, " frequency"]
    sensitivity: Complex[np.ndarray, " frequency"]
    complementary: Complex[np.ndarray, " frequency"]
    effort: Complex[np.ndarray, " frequency"]

    @property
    def robustness(self) -> float:
        """Largest |W T|: below 1 every plant of the envelope is stable under this controller."""
        return float(np.max(np.abs(self.weights.uncertainty(1j * self.frequency) * self.complementary)))

    def __str__(self) -> str:
        verdict = "every plant of the envelope is stable" if self.robustness < 1 else "the envelope is not covered"
        return (
            f"Controller of order {self.controller.nstates}: gamma = {self.gamma:.3f} (smallest reached {self.optimum:.3f}, "
            f"none below {self.bound:.3f}), closed loop stable, max |W T| = {self.robustness:.3f}: {verdict}."
        )


def mixed_sensitivity(nominal: Linear, weights: Weights, *, relax: float = 1.15, limit: float = 1.0) -> Synthesis:
    """Return the controller that makes the norm of [W_1 W_d C S; W_2 W_d T; W_3 W_d S] small, equation (9).

    Gamma is found by bisection over suboptimal problems, each solved by slycot's SB10FD and then checked: the closed loop
    must be stable and its norm, computed from it, no larger than asked for. The single call behind python-control's
    `mixsyn` (SB10AD) is not used, because the gamma that it reports is not that of the controller that it returns where
    the Riccati equations become ill-conditioned: for the weights of the paper it says 0.26 to 0.52, depending on
    the realisation, for closed loops of norm 0.60 to 0.71.

    Args:
        nominal: P_0.
        weights: as printed in the paper (`paper_weights`) or proposed (`propose_weights`).
        relax: gamma of the controller over the smallest one. The optimal controller makes all frequencies equally bad;
            one that is a little worse spends much less effort where nothing is to be gained. Never so far that the limit
            is passed.
        limit: the largest gamma to accept; 1 where the weights are meant literally, infinity to see what comes out.

    Raises:
        InfeasibleError: no controller stabilises the plant, or none reaches the limit; says which weights exclude
            each other where.
        ValueError: the plant is not a proper, finite, continuous linear system, or an option is out of range.
    """
    if not (np.isfinite(relax) and relax >= 1) or not limit > 0:
        raise ValueError(f"relax is {relax} and limit is {limit}; give relax of at least 1 and a positive limit.")
    plant = plant_of(nominal)
    frequency = frequencies(plant, weights)
    bound, place = _bound(weights, frequency)
    if bound > limit:
        raise InfeasibleError(_conflict(weights, place, bound, limit))
    problem = _generalised(plant, weights)
    best = _attempt(problem, _LARGEST)
    if best is None:
        raise InfeasibleError(
            "no controller stabilises the nominal plant with finite gamma; look for an unstable mode that the motor "
            "cannot move or the cart does not show, or poles and zeros on the imaginary axis."
        )
    high, low = _LARGEST, bound * (1 - 10 * _DIGITS)
    while high > (1 + _DIGITS) * low:
        middle = float(np.sqrt(low * high))
        found = _attempt(problem, middle)
        if found is None:
            low = middle
        else:
            high, best = middle, min(best, found, key=lambda pair: pair[1])
    asked = max(best[1], min(best[1] * relax, limit / (1 + _HONEST)))
    controller, gamma = _attempt(problem, asked) or best
    if gamma > limit:
        raise InfeasibleError(
            f"the smallest gamma is {gamma:.3g}, above the limit of {limit:g}: {_worst(plant, controller, weights, frequency)}."
        )
    s, t, cs = loop_functions(plant, controller, frequency)
    return Synthesis(controller, gamma, best[1], bound, place, plant, weights, frequency, s, t, cs)


def loop_functions(
    plant: Linear, controller: Linear, frequency: Float[np.ndarray, " frequency"]
) -> tuple[Complex[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"]]:
    """Return S, T and C S of the loop u = -C y."""
    c = finite_response(controller, frequency, "the controller")
    loop = c * finite_response(plant, frequency, "the nominal plant")
    return 1 / (1 + loop), loop / (1 + loop), c / (1 + loop)


def closed_gamma(plant: Linear, controller: Linear, weights: Weights) -> float:
    """Return the norm (9) of any controller's closed loop; infinite where that is not stable."""
    return _norm(_generalised(plant_of(plant), weights), plant_of(controller))


def frequencies(plant: ct.StateSpace, weights: Weights) -> Float[np.ndarray, " frequency"]:
    """Return frequencies that cover plant and weights [rad/s].

    They run from well below the slowest to well above the fastest pole or zero, and lie close about each resonance.
    """
    systems = (plant, weights.effort, weights.uncertainty, weights.performance)
    places = np.concatenate([part(system) for system in systems for part in (poles_of, zeros_of)])
    places = places[np.abs(places) > 1e-6]
    sizes = np.abs(places) if places.size else np.ones(1)
    wide = np.geomspace(0.05 * np.min(sizes), 20 * np.max(sizes), _FREQUENCIES)
    near = [p.imag + 5 * abs(p.real) * np.linspace(-1, 1, 101) for p in places if p.imag > abs(p.real)]
    every = np.concatenate([wide, *near])
    return np.unique(every[every >= wide[0]])


def _generalised(plant: ct.StateSpace, weights: Weights) -> ct.StateSpace:
    """Return the system from (w, u) to (effort u, uncertainty y, performance (w - y), w - y) with y = P_0 u."""
    parts = [
        ct.ss(system, inputs=[into], outputs=[out], name=f"part_{out}")
        for system, into, out in (
            (plant, "u", "y"),
            (weights.effort, "u", "z1"),
            (weights.uncertainty, "y", "z2"),
            (weights.performance, "e", "z3"),
        )
    ]
    error = ct.summing_junction(["w", "-y"], "e", name="error")
    return state_space(ct.interconnect([*parts, error], inputs=["w", "u"], outputs=["z1", "z2", "z3", "e"]))


def _attempt(problem: ct.StateSpace, gamma: float) -> tuple[ct.StateSpace, float] | None:
    """Return a controller with this gamma and the norm of its closed loop; None where there is none that keeps its promise."""
    matrices = (np.array(x) for x in (problem.A, problem.B, problem.C, problem.D))
    try:
        found = sb10fd(problem.nstates, 2, 4, 1, 1, gamma, *matrices, tol=0.0)
    except (SlycotError, ArithmeticError):
        return None
    controller = ct.StateSpace(*found[:4], inputs=["cart_position"], outputs=["torque"], name="controller")
    norm = _norm(problem, controller)
    return (controller, norm) if norm <= gamma * (1 + _HONEST) else None


def _norm(problem: ct.StateSpace, controller: ct.StateSpace) -> float:
    closed = problem.lft(controller)
    if not np.all(np.isfinite(closed.A)) or not is_stable(closed):
        return float("inf")
    return float(ct.linfnorm(closed)[0])


def _bound(weights: Weights, frequency: Float[np.ndarray, " frequency"]) -> tuple[float, float]:
    """Return the least of |(W T, W_3 W_d S)| over all S and T with S + T = 1, at the frequency where it is largest."""
    robust, fast = (
        np.abs(finite_response(w, frequency, name))
        for w, name in ((weights.uncertainty, "uncertainty"), (weights.performance, "performance"))
    )
    least = robust * fast / np.sqrt(robust**2 + fast**2)
    place = int(np.argmax(least))
    return float(least[place]), float(frequency[place])


def _conflict(weights: Weights, place: float, bound: float, limit: float) -> str:
    robust, fast = (float(np.abs(w(1j * place))) for w in (weights.uncertainty, weights.performance))
    return (
        f"no controller has a gamma below {bound:.3g} (the limit is {limit:g}): at {place:.3g} rad/s the uncertainty weight "
        f"{robust:.3g} on T and the performance weight {fast:.3g} on S exclude each other, since S + T = 1; lower one of them."
    )


def _worst(plant: ct.StateSpace, controller: ct.StateSpace, weights: Weights, frequency: np.ndarray) -> str:
    s, t, cs = loop_functions(plant, controller, frequency)
    rows = {"effort": cs, "uncertainty": t, "performance": s}
    sizes = {name: np.abs(getattr(weights, name)(1j * frequency) * row) for name, row in rows.items()}
    name = max(sizes, key=lambda n: float(np.max(sizes[n])))
    place = int(np.argmax(sizes[name]))
    return f"the {name} weight is the tightest, at {frequency[place]:.3g} rad/s; lower it there"
