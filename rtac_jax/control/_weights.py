"""Weights of the mixed sensitivity problem (9): the paper's own, and proposals for any nominal plant."""

import dataclasses

import control as ct
import numpy as np

from rtac_jax.control._checks import (
    Linear,
    coefficients,
    finite_response,
    is_stable,
    plant_of,
    poles_of,
    weight_of,
    zeros_of,
)

# Rules of the proposal, found by a search over closed loops of the plant of Table 1(c) and its relatives 15 % about it.
_LINEAR_FRACTION = 1 / 3  # of the displacement that uses the whole effort; above it the motor saturates
_PERFORMANCE = 0.6  # W_3
_EFFORT = 0.2  # |W_1 W_d C S| at the resonance under the loop that is aimed at, over W_3
_AIM = (
    0.87  # gamma at the resonance of W T and W_3 W_d S alone; leaves room below 1 for effort and a relaxed controller
)
_LOW, _HIGH = 0.05, 8.0  # band of the controller, in resonance frequencies
_LEAST, _MOST = 0.05, 0.95  # |S| at the resonance that is worth aiming at


@dataclasses.dataclass(frozen=True)
class Weights:
    """The weights of the three rows of (9), each with W_d multiplied in and common factors cancelled.

    The norm of (9) is that of [effort C S; uncertainty T; performance S]. W_1 and W_2 have 1/W_d as a factor, so they are
    never needed by themselves: `effort` = W_1 W_d and `uncertainty` = W_2 W_d = W have neither its poles nor its zeros.

    Attributes:
        effort: W_1 W_d, on the controller's output C S.
        uncertainty: W_2 W_d, which is W of (7), on T.
        performance: W_3 W_d, on S.
        desired: W_d, which moves the dominant poles.

    Raises:
        ValueError: a weight is not continuous, one-to-one, proper, stable and finite, or effort vanishes at high
            frequency, where the problem would be singular.
    """

    effort: ct.TransferFunction
    uncertainty: ct.TransferFunction
    performance: ct.TransferFunction
    desired: ct.TransferFunction

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, weight_of(getattr(self, field.name), field.name))
        if len(zeros_of(self.effort)) < len(poles_of(self.effort)):
            raise ValueError("the effort weight vanishes at high frequency; give it as many zeros as poles.")

    @property
    def w1(self) -> ct.TransferFunction:
        """W_1 = effort / W_d."""
        return _quotient(self.effort, self.desired)

    @property
    def w2(self) -> ct.TransferFunction:
        """W_2 = W / W_d."""
        return _quotient(self.uncertainty, self.desired)

    @property
    def w3(self) -> ct.TransferFunction:
        """W_3 = performance / W_d."""
        return _quotient(self.performance, self.desired)


def paper_nominal() -> ct.TransferFunction:
    """Return P_0 of section 5.3: from nondimensional torque to nondimensional position, time in seconds."""
    zeros = [175.7, -32.7, -14.5 + 26.6j, -14.5 - 26.6j]
    poles = [-2.7 + 12.9j, -2.7 - 12.9j, -4.1 + 37.4j, -4.1 - 37.4j]
    return ct.TransferFunction(
        3.7e-3 * np.real(np.poly(zeros)), np.real(np.poly(poles)), inputs=["torque"], outputs=["cart_position"]
    )


def paper_uncertainty() -> ct.TransferFunction:
    """Return W of equation (8)."""
    return ct.TransferFunction(0.55 * np.polymul([1 / 2, 1], [1 / 80, 1]), np.polymul([1 / 5, 1], [1 / 1000, 1]))


def paper_weights() -> Weights:
    """Return the weights of section 5.4 as printed: W_1 W_d is the band-stop filter alone, W_2 W_d is W, W_3 = 0.17."""
    band_stop = ct.TransferFunction(
        0.15 * np.polymul([1, 2.4, 8**2], [1, 4.2, 14**2]),
        np.polymul(np.polymul([1 / 1.4, 8], [1 / 1.4, 8]), np.polymul([1 / 0.7, 14], [1 / 0.7, 14])),
    )
    desired = _moved_poles(complex(-2.7, 12.9), 10.0)
    return Weights(band_stop, paper_uncertainty(), _scaled(desired, 0.17), desired)


def propose_weights(
    nominal: Linear,
    uncertainty: Linear,
    torque_limit: float,
    *,
    displacement: float,
    band: tuple[float, float] = (0.0, np.inf),
) -> Weights:
    """Propose weights that spend the torque on the damping of the plant's dominant mode, for any plant and envelope.

    - W_d moves the dominant poles, those of the highest resonance, from damping l_0 to l_d = l_0 + |R| c: R is their
      residue, c the controller's gain there that uses the whole torque at a third of the displacement. From
      larger displacements the motor saturates, which lowers the gain of the loop but cannot make it unstable as long as
      the plant is stable. With S = l_0/l_d and T = 1 - S there, the least norm of W T and a performance row is
      |W| sqrt(T), so less damping is asked for where the envelope is wide.
    - W_3 is 0.6: far from the resonance, where nothing can be gained, |S| may rise to 1.7 gamma.
    - W_1 W_d falls as 1/s up to eight times the resonance and rises beyond it. So the controller has almost no gain at low
      frequency, where an offset of the sensor or a cart held by dry friction would wind up an arm that nothing pulls
      back, and at high frequency, where there is only noise and what the nominal plant leaves out.

    Args:
        nominal: P_0, stable, with an oscillatory pole pair.
        uncertainty: W, multiplicative.
        torque_limit: largest amplitude of the plant's input, in its units; see `effort_limit`.
        displacement: from which the cart is to be brought to rest, in units of the plant's output.
        band: where the plant was measured [rad/s]; what a fitted plant does outside is not taken for its resonance.

    Raises:
        ValueError: the plant has no oscillatory poles in the band or is not stable, a limit is not positive, the torque adds no
            damping from there, or the envelope is so wide at the resonance that none can be added.
    """
    plant, weight = plant_of(nominal), weight_of(uncertainty, "uncertainty")
    for name, value in (("torque_limit", torque_limit), ("displacement", displacement)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, but must be positive and finite, in the nominal plant's units.")
    pole, residue = _dominant(plant, band)
    resonance, damping = float(abs(pole)), float(-pole.real)
    gain = torque_limit / (_LINEAR_FRACTION * displacement)
    width = float(np.abs(finite_response(weight, np.array([resonance]), "uncertainty"))[0])
    aimed = max(damping / (damping + abs(residue) * gain), _LEAST)
    sensitivity = max(aimed, 1.0 - (_AIM / max(width, _AIM)) ** 2)
    if aimed > _MOST:
        raise ValueError(
            f"a torque of {torque_limit:.3g} adds no damping that counts from a displacement of {displacement:.3g}, both in the "
            "nominal plant's units; start from a smaller displacement, or allow more torque."
        )
    if sensitivity > _MOST:
        raise ValueError(
            f"the uncertainty weight is {width:.3g} at the resonance of {resonance:.3g} rad/s, so wide that no damping can be "
            "added there; choose a nominal plant nearer to the middle of the envelope, or narrow the envelope: larger currents "
            "about the resonance, less dry friction, conditions that differ less."
        )
    desired = _moved_poles(pole, damping / sensitivity)
    size = _EFFORT * _PERFORMANCE / (gain * sensitivity)
    shape = ct.TransferFunction(
        np.polymul([1 / (_HIGH * resonance), 1], [1 / (_HIGH * resonance), 1]),
        np.polymul([1 / resonance, _LOW], [1 / (30 * _HIGH * resonance), 1]),
    )
    return Weights(_scaled(shape, size), weight, _scaled(desired, _PERFORMANCE), desired)


def _dominant(plant: ct.StateSpace, band: tuple[float, float]) -> tuple[complex, complex]:
    """Return the oscillatory pole with the highest resonance in the band, and the plant's residue there."""
    poles, left = (np.array(x, dtype=complex) for x in np.linalg.eig(np.array(plant.A)))
    if not is_stable(plant):
        raise ValueError("the nominal plant is not stable; weights are proposed for stable plants only.")
    rows = np.linalg.solve(left, np.array(plant.B))[:, 0]
    residues = (np.array(plant.C) @ left)[0] * rows
    rising = np.flatnonzero(np.imag(poles) > 1e-6 * np.abs(poles))
    if not rising.size:
        raise ValueError("the nominal plant has no oscillatory poles; there is no resonance to damp.")
    rising = rising[(np.abs(poles[rising]) >= band[0]) & (np.abs(poles[rising]) <= band[1])]
    if not rising.size:
        raise ValueError(
            f"the nominal plant has no oscillatory poles from {band[0]:.3g} to {band[1]:.3g} rad/s, where it was measured; measure "
            "around its resonance."
        )
    best = rising[np.argmax(np.abs(residues[rising]) / -np.real(poles[rising]))]
    return complex(poles[best]), complex(residues[best])


def _moved_poles(pole: complex, damping: float) -> ct.TransferFunction:
    """Return a filter that replaces the pole and its conjugate by ones of the same frequency with this damping [rad/s]."""
    return ct.TransferFunction([1.0, 2 * damping, damping**2 + pole.imag**2], [1.0, -2 * pole.real, abs(pole) ** 2])


def _scaled(system: ct.TransferFunction, factor: float) -> ct.TransferFunction:
    above, below = coefficients(system)
    return ct.TransferFunction(factor * above, below)


def _quotient(over: ct.TransferFunction, under: ct.TransferFunction) -> ct.TransferFunction:
    """Return over / under, without the factors that both have."""
    zeros, poles = (
        list(np.concatenate([zeros_of(over), poles_of(under)])),
        list(np.concatenate([poles_of(over), zeros_of(under)])),
    )
    for zero in list(zeros):
        near = [p for p in poles if abs(p - zero) <= 1e-9 * max(abs(zero), 1.0)]
        if near:
            zeros.remove(zero)
            poles.remove(near[0])
    (a, b), (c, d) = coefficients(over), coefficients(under)
    gain = a[0] / b[0] * d[0] / c[0]
    return ct.TransferFunction(gain * np.atleast_1d(np.real(np.poly(zeros))), np.atleast_1d(np.real(np.poly(poles))))
