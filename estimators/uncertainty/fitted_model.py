"""The fitted physical model beside an envelope: inside or outside, and whether the nominal model resonates where it does."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Complex128, Float64

from estimators.uncertainty.envelope import Envelope
from estimators.uncertainty.uncertainty_structures import errors
from rtac_jax import RTAC, linearise
from rtac_jax.equations import dead_time, friction_levels

Curve = Float64[np.ndarray, " frequency"]
Response = Callable[[Curve], Complex128[np.ndarray, " frequency"]]

_FAR = 6.0  # dB between the peaks: dry friction, which has no linearisation, doubles the damping of a rig that moves enough
_NEAR = 3.0  # dB between the peaks, half of the power, within which the excitation is not what is wrong
_DRY = (
    "The peaks are near each other, so another excitation would change little: W covers what was recorded, and every condition has "
    "the dry friction that the linearisation leaves out. Larger currents let the cart move more beside it, as far as the arm does "
    "not swing far."
)
_OTHERWISE = (
    "The peaks are near each other, so another excitation would change little: W covers what was recorded, and the fitted model, "
    "which has no dry friction, is not what was recorded. Ask `diagnose` what it lacks, and check the gains and delays of its "
    "drive and sensors."
)
_PROMINENT = 3.0  # dB by which a mode stands out of the curve: half of the power
_ELSEWHERE = 1.2  # ratio of frequencies from which on a peak is another mode
_POINTS = 2000
# Of the recommended excitation, by trials on the paper's rig, where the peak of P_0 came from 15 to 4 dB below the fitted model's
# and this from 6.4 to 1.7 times outside W: the arm's swing [rad rms], the relative width of the spectrum's peak, and its length in
# periods of the resonance.
_SWING, _WIDTH, _PERIODS = 0.55, 0.15, 33.0


@dataclass(frozen=True, eq=False)
class FittedInEnvelope:
    """The fitted model, linearised, beside an envelope.

    Attributes:
        frequency: [rad/s].
        response: of the fitted model, from current times cos(theta) [A] to cart position [m].
        distance: the largest |Delta| that it needs; at most 1 inside the envelope.
        at: where that is [rad/s].
        peak_db: the peak of P_0 less that of the fitted model [dB].
        resonance: of the fitted model [rad/s].
        spurious: modes that P_0 has and the fitted model has not [rad/s].
        remedy: the excitation that would bring the two together.
        spring: whether it has the electric spring on the arm that the conditions were given for a controller.
        dry: whether it has dry friction, which its linearisation leaves out.
    """

    frequency: Curve
    response: Complex128[np.ndarray, " frequency"]
    distance: float
    at: float
    peak_db: float
    resonance: float
    spurious: tuple[float, ...]
    remedy: str
    spring: bool = False
    dry: bool = True

    @property
    def agrees(self) -> bool:
        """Return whether the fitted model lies inside, and P_0 has its peak and no other."""
        return self.distance <= 1 and abs(self.peak_db) <= _FAR and not self.spurious

    def sentences(self) -> list[str]:
        """Say where the envelope and the fitted model part, and what to record instead; one line where they agree."""
        where = (
            f"outside W by {100 * (self.distance - 1):.2g} %, at {self.at:.3g} rad/s"
            if 1 < self.distance < 2
            else f"{self.distance:.1f} times outside W, most at {self.at:.3g} rad/s"
            if self.distance > 1
            else f"inside W (largest |Delta| {self.distance:.2f}, at {self.at:.3g} rad/s)"
        )
        as_drawn = (
            "linearised"
            + self.dry * " without dry friction"
            + self.spring * " and, as the conditions, with the electric spring on the arm"
        )
        if self.agrees:
            return [f"The fitted model, {as_drawn}, lies {where}; P0 peaks {self.peak_db:+.1f} dB beside it."]
        side = "below" if self.peak_db < 0 else "above"
        said = (
            f"P0 and the fitted model do not meet: the fitted model, {as_drawn}, lies {where}, and the peak "
            f"of P0 is {abs(self.peak_db):.1f} dB {side} that of the fitted model at {self.resonance:.3g} rad/s"
        )
        if self.spurious:
            named = " and ".join(f"{omega:.2g}" for omega in self.spurious)
            said += f", and P0 has a mode at {named} rad/s that the fitted model has not"
        return [f"{said}.", self.remedy]


def fitted_in_envelope(
    model: RTAC, found: Envelope, *, with_spring: Response | None = None, nothing: Collection[str] = ()
) -> FittedInEnvelope:
    """Hold the fitted model, linearised about theta = 0, against an envelope.

    Args:
        model: with fitted values.
        found: an envelope of responses from current times cos(theta) to cart position.
        with_spring: response of the model with the electric spring on the arm, by frequency [rad/s], where the envelope is of
            conditions with it; by default that of the model alone is held against the envelope.
        nothing: names of parameters that the fit does not tell from nothing: such dry friction is none.

    Raises:
        ValueError: as `rtac_jax.linearise`.
    """
    of = with_spring or _plain(model)
    omega = np.geomspace(found.frequency[0], found.frequency[-1], _POINTS)
    fitted, nominal = of(omega), found.nominal_response(omega)
    model_error = np.abs(errors(fitted[None], nominal, found.kind))[0] / found.weight_magnitude(omega)
    at = int(np.argmax(model_error))
    size, own = (20 * np.log10(np.maximum(np.abs(x), 1e-300)) for x in (fitted, nominal))
    resonance = float(omega[np.argmax(size)])
    known = [resonance, *omega[_peaks(size)]]
    spurious = tuple(
        float(one) for one in omega[_peaks(own)] if all(max(one / other, other / one) > _ELSEWHERE for other in known)
    )
    peak_db = float(own.max() - size.max())
    at_rest = tuple(jnp.zeros(len(model.states)))
    none = {name: 0.0 for name in nothing if model.parameters[name].null == 0}
    dry = any(float(np.max(x)) > 0 for levels in friction_levels(model.with_values(none), at_rest) for x in levels)
    return FittedInEnvelope(
        omega, fitted, float(model_error[at]), float(omega[at]), peak_db, resonance, spurious,
        (_DRY if dry else _OTHERWISE) if abs(peak_db) <= _NEAR and not spurious else _remedy(model, resonance),
        with_spring is not None, dry,
    )  # fmt: skip


def _plain(model: RTAC) -> Response:
    plant: Any = linearise(model, drive="current", delay_order=0)["cart_position", "current"]
    late = float(dead_time(model))
    return lambda omega: (np.asarray(plant(1j * omega)).ravel() * np.exp(-1j * late * omega)).astype(np.complex128)


def _peaks(size: Curve) -> Any:
    return scipy.signal.find_peaks(size, prominence=_PROMINENT)[0]


def _remedy(model: RTAC, resonance: float) -> str:
    """Recommend the multisine whose energy lies at the resonance, as large as the arm's swing allows.

    Elsewhere a current moves the arm and hardly the cart, which dry friction then holds; and from where the arm has swung far,
    cos(theta) is no constant.
    """
    per_ampere = float(model["torque_constant"]) / (float(model["arm_inertia"]) * resonance**2)
    hertz = resonance / (2 * np.pi)
    return (
        f"Such responses come from carts that dry friction holds and arms that swing far: play a multisine of "
        f"{1e3 * _SWING / per_ampere:.2g} mA rms whose lines peak as the resonance does, amplitudes=1 / np.hypot(1 - r**2, "
        f"{_WIDTH:g} * r) with r the frequency over {hertz:.3g} Hz, for {_PERIODS / hertz:.0f} s or longer, from an arm at "
        f"rest near theta = 0 or pi; where friction still holds the cart, less of it is the only remedy."
    )
