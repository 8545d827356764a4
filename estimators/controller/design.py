"""Design of a controller from an envelope and a fitted model, and its trial on that model."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import control as ct
import numpy as np
from jaxtyping import Complex128, Float

from estimators.controller.outcome import OFF, ControlDesign
from estimators.controller.plant_sampling import plants_inside
from estimators.core.fit import Fit
from estimators.frequency_response.response import FrequencyResponses
from estimators.uncertainty.envelope import Envelope, envelope
from rtac_jax import RTAC, linearise
from rtac_jax.arguments import checked_arguments
from rtac_jax.control import (
    Actuation,
    ClosedLoop,
    InfeasibleError,
    Reduction,
    Synthesis,
    Units,
    Weights,
    closed_loop,
    discretise,
    margins,
    mixed_sensitivity,
    nominal_plant,
    paper_nominal,
    paper_weights,
    propose_weights,
    reduce_controller,
)

PLANTS = 2000  # in each batch
SOONER = 2 / 3  # of the time without a controller, within which a plant has to settle
Curve = Float[np.ndarray, " frequency"]
_SHORTEST, _LONGEST = 8.0, 64.0  # s, of a simulation
_FARTHEST = 1.0  # m, beyond which a displacement is taken for millimetres
_TOLD = 0.5  # standard deviation over estimate from which an interval of 95 % holds zero
_ANGLE = 1e-3  # rad, noise of an angle that the recording does not have


class _Attempt(NamedTuple):
    """The design that one envelope leads to."""

    covered: Envelope
    weights: Weights
    synthesis: Synthesis
    reduction: Reduction
    recursion: ct.StateSpace
    closed: ClosedLoop


@checked_arguments
def control(
    fit: Fit,
    covered: Envelope | Sequence[Envelope],
    responses: FrequencyResponses,
    *,
    sample_time: float,
    displacement: float = 0.015,
    torque_limit: float = 0.1,
) -> ControlDesign:
    """Design an H-infinity controller for an envelope and try it on the fitted nonlinear model (section 5.4, Fig. 8).

    The electric spring that holds the arm is put into the envelope, weights are proposed from it, and the mixed
    sensitivity problem (9) is solved; the controller is reduced, sampled, and simulated with the model, its friction,
    the motor's limit and the sensors' noise, and with many plants that differ from it.

    Args:
        fit: of the nonlinear model, to the same recording.
        covered: multiplicative, of `responses`; of several that whose controller settles the fitted model soonest is kept.
        responses: of all conditions, from current times cos(theta) [A] to cart position [m].
        sample_time: of the controller [s].
        displacement: from which the cart is to be brought to rest [m].
        torque_limit: of the motor [N m].

    Raises:
        ValueError: a displacement in another unit, or the envelope is of another kind or of other responses, or for every
            envelope: it is too wide at the resonance for any damping, the problem is infeasible, the sampled loop is not
            stable, or the closed loop with the fitted model runs away.
        RuntimeError: `rtac_jax.configure()` was not called.
    """
    if not 0 < displacement < _FARTHEST:
        raise ValueError(
            f"displacement: is {displacement:g} m; give metres between 0 and {_FARTHEST:g}, such as 0.015."
        )
    envelopes = [covered] if isinstance(covered, Envelope) else list(covered)
    _check(envelopes, responses)
    model = fit.model
    units, actuation = Units.nondimensional(model), Actuation.proposed(model, motor_limit=torque_limit)

    def loop(plants: RTAC, law: ct.StateSpace | None, *, noise: tuple[float, float] = (0.0, 0.0)) -> ClosedLoop:
        return closed_loop(
            plants, law, units=units, actuation=actuation, displacement=displacement, duration=duration,
            sample_time=sample_time, torque_constant=float(model["torque_constant"]), position_noise=noise[0],
            angle_noise=noise[1],
        )  # fmt: skip

    def attempt(found: Envelope) -> _Attempt:
        covered = _with_spring(model, actuation, found, responses)
        per_current = float(model["torque_constant"]) * units.torque
        plant = ct.ss(covered.nominal) * (units.position / per_current)
        weights = propose_weights(
            plant,
            covered.weight,
            actuation.controller_limit * units.torque,
            displacement=displacement * units.position,
            band=(float(covered.frequency[0]), float(covered.frequency[-1])),
        )
        synthesis = mixed_sensitivity(plant, weights)
        reduction = reduce_controller(synthesis)
        recursion = discretise(reduction.controller, synthesis.nominal, sample_time)
        noise = (fit.noise.get("cart_position", 0.0), fit.noise.get("arm_angle", _ANGLE))
        closed = loop(model, recursion, noise=noise)
        if not np.all(np.isfinite(closed.cart_position)):
            raise InfeasibleError("the closed loop with the fitted nonlinear model runs away; lower --displacement.")
        return _Attempt(covered, weights, synthesis, reduction, recursion, closed)

    duration = _SHORTEST
    free = loop(model, None)
    while not np.isfinite(free.settling_time()[0]) and duration < _LONGEST:
        duration *= 2
        free = loop(model, None)
    alone = float(free.settling_time()[0])
    made, refusals = [], []
    for found in envelopes:
        try:
            made.append(attempt(found))
        except ValueError as error:
            refusals.append(error)
    if not made:
        raise refusals[0]
    best = min(made, key=lambda one: (float(one.closed.settling_time()[0]), float(np.std(one.closed.cart_position))))
    plants = _off(model)
    within = SOONER * (alone if np.isfinite(alone) else duration)
    off = loop(plants, best.recursion)
    while not np.all(np.isfinite(off.settling_time())) and duration < _LONGEST:  # plants that differ may settle later
        duration *= 2
        off = loop(plants, best.recursion)
    inside = plants_inside(best.covered, model, actuation, off=OFF, count=PLANTS)
    printed = mixed_sensitivity(paper_nominal(), paper_weights())
    doubt, nothing = _doubt(fit)
    return ControlDesign(
        covered=best.covered, units=units, actuation=actuation, weights=best.weights, synthesis=best.synthesis,
        reduction=best.reduction, margins=margins(best.synthesis.nominal, best.recursion, best.weights),
        controller=_in_si(best.reduction.controller, units), sampled=_in_si(best.recursion, units),
        displacement=displacement, within=within, free=free,
        closed=best.closed, off=off, off_free=loop(plants, None),
        drawn=loop(_drawn(fit), best.recursion), inside=None if inside is None else loop(inside, best.recursion),
        doubt=doubt, nothing=nothing, farthest=fit.farthest, inside_free=None if inside is None else loop(inside, None),
        printed_bound=(printed.bound, printed.bound_frequency),
    )  # fmt: skip


def _check(envelopes: Sequence[Envelope], responses: FrequencyResponses) -> None:
    if not envelopes:
        raise ValueError("covered: holds no envelope; give at least one.")
    names, grid = tuple(one.name for one in responses), responses.frequency
    for found in envelopes:
        if not found.kind.startswith("multiplicative"):
            raise ValueError(f"covered: is {found.kind}; control needs an envelope with kind='multiplicative_output'.")
        if found.names != names or not np.array_equal(found.frequency, grid):
            raise ValueError("covered: was made of other responses; give those of which the envelope was made.")
    responses.require("current", "cart_position")


def _with_spring(model: RTAC, actuation: Actuation, found: Envelope, responses: FrequencyResponses) -> Envelope:
    """Return the envelope of what the controller sees once the electric spring holds the arm.

    The spring is no part of the recording, so each response is multiplied by what the spring does to the linearised
    model. The nominal model gets the spring's two states alone, and the weight covers what that leaves out.
    """
    factor = _spring_factor(model, actuation, found.frequency)
    changed = [
        dataclasses.replace(
            one, response=one.response * factor, std=one.std * np.abs(factor), noise_std=one.noise_std * np.abs(factor)
        )
        for one in responses
    ]
    linear = linearise(model, delay_order=0)
    damping, gain = -float(np.array(linear.A)[3, 3]), float(np.array(linear.B)[3, 0])
    spring = ct.TransferFunction([1.0, damping, 0.0], [1.0, damping, gain * actuation.arm_stiffness])
    order = len(np.asarray(found.weight.poles()))
    return envelope(
        FrequencyResponses(tuple(changed)), nominal=_series(found.nominal, spring), order_weight=order,
        minimise=found.minimise, held_out=[int(i) for i in np.flatnonzero(found.held_out)], progress=False,
    )  # fmt: skip


def _spring_factor(model: RTAC, actuation: Actuation, omega: Curve) -> Complex128[np.ndarray, " frequency"]:
    """Return what the electric spring multiplies the linearised model's response by."""
    plain, held = (nominal_plant(model, units=Units.si(), actuation=a)(1j * omega) for a in (None, actuation))
    return np.asarray(held) / np.asarray(plain)


def with_arm_spring(model: RTAC, actuation: Actuation) -> Callable[[Curve], Complex128[np.ndarray, " frequency"]]:
    """Return the linearised model's response from current [A] to cart position [m], with the electric spring on the arm.

    Args:
        model: of the rig.
        actuation: gives the spring.
    """
    plant = linearise(model, drive="current")["cart_position", "current"]

    def response(omega: Curve) -> Complex128[np.ndarray, " frequency"]:
        alone = np.asarray(plant(1j * omega)).ravel()
        return (alone * _spring_factor(model, actuation, omega)).astype(np.complex128)

    return response


def _series(first: ct.TransferFunction, then: ct.TransferFunction) -> ct.TransferFunction:
    (a, b), (c, d) = ((np.asarray(one.num[0][0]), np.asarray(one.den[0][0])) for one in (first, then))
    return ct.TransferFunction(np.polymul(a, c), np.polymul(b, d))


def _in_si(controller: ct.StateSpace, units: Units) -> ct.StateSpace:
    factor = units.position / units.torque
    a, b, c, d = (np.asarray(getattr(controller, part), dtype=float) for part in "ABCD")
    return ct.StateSpace(
        a, b, factor * c, factor * d, controller.dt, inputs=["cart_position"], outputs=["torque"], name="controller"
    )


def _off(model: RTAC, seed: int = 0) -> RTAC:
    """Return plants with every parameter up to 15 % off."""
    random = np.random.default_rng(seed)
    return model.with_values(
        {name: float(model[name]) * (1 + OFF * random.uniform(-1, 1, PLANTS)) for name in model.parameters}
    )


def _doubt(fit: Fit) -> tuple[float, tuple[str, ...]]:
    """Return the largest standard deviation as a fraction of its parameter, and the names of those not told from nothing.

    A fraction of what may be nothing says nothing.
    """
    std = np.sqrt(np.diagonal(fit.information.own_covariance))
    fractions = {
        name: float(s / max(abs(float(fit.model[name])), 1e-300))
        for name, s in zip(fit.information.names, std, strict=True)
    }
    told = [fraction for fraction in fractions.values() if fraction < _TOLD]
    return max(told, default=0.0), tuple(name for name, fraction in fractions.items() if fraction >= _TOLD)


def _drawn(fit: Fit, seed: int = 0) -> RTAC:
    """Return plants drawn from the covariance of the estimates."""
    names, random = fit.information.names, np.random.default_rng(seed)
    middle = np.array([float(fit.model[name]) for name in names])
    covariance = fit.information.own_covariance
    std = np.sqrt(np.diagonal(covariance))  # the correlations are drawn, as the sizes differ by many decades
    unit = random.multivariate_normal(np.zeros(len(names)), covariance / np.outer(std, std), PLANTS, method="eigh")
    rows: Float[np.ndarray, "plant parameter"] = middle + std * unit
    kept = np.abs(rows) * np.sign(middle)  # no spring or friction changes its sign
    return fit.model.with_values({name: kept[:, i] for i, name in enumerate(names)})
