"""The closed form, linearised, held against an envelope and the frequency responses that it covers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex128, Float64

from estimators.closed_form.fit import least_squares
from estimators.closed_form.table1 import CONSISTENT
from estimators.frequency_response.response import FrequencyResponses
from estimators.uncertainty.envelope import Envelope
from estimators.uncertainty.uncertainty_structures import errors
from rtac_jax import RTAC, linearise
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording

_IN_RESPONSE = ("eccentric_moment", "torque_constant", "spring_stiffness")


@dataclass(frozen=True, eq=False)
class ClosedFormCheck:
    """A model of the physics, linearised about theta = 0, beside an envelope.

    Attributes:
        model: the weak form's, of the same recording.
        frequency: [rad/s].
        response: from current times cos(theta) [A] to cart position [m].
        needed: |Delta| that it needs at each frequency; at most 1 inside W.
        ratio: its magnitude over the responses' geometric mean, at each frequency.
    """

    model: RTAC
    frequency: Float64[np.ndarray, " frequency"]
    response: Complex128[np.ndarray, " frequency"]
    needed: Float64[np.ndarray, " frequency"]
    ratio: Float64[np.ndarray, " frequency"]

    @property
    def inside(self) -> bool:
        """Return whether it lies inside W at every frequency."""
        return bool(np.all(self.needed <= 1.0))

    @property
    def words(self) -> str:
        """Return one sentence: inside W or outside, and where."""
        at = int(np.argmax(self.needed))
        most = f"|Δ| of {self.needed[at]:.3g} at {self.frequency[at]:.3g} rad/s"
        if self.inside:
            return f"The closed form, linearised, lies inside W: it needs at most a {most}."
        out = self.frequency[self.needed > 1.0]
        between = f"from {out[0]:.3g} to {out[-1]:.3g} rad/s" if len(out) > 1 else f"at {out[0]:.3g} rad/s"
        fraction = np.mean(self.needed > 1.0)
        dry = "cart_coulomb.level" in self.model.parameters and float(self.model["cart_coulomb.level"]) > 0
        why = (
            f" There its magnitude is {self.ratio[at]:.2g} times the responses' mean"
            + (", which contain the dry friction that a linearisation leaves out" if dry and self.ratio[at] > 1 else "")
            + "."
        )
        return (
            f"The closed form, linearised, lies outside W {between} ({100 * fraction:.0f} % of the lines): "
            f"it needs a {most}.{why}"
        )


@checked_arguments
def closed_form_check(recording: Recording, found: Envelope, responses: FrequencyResponses) -> ClosedFormCheck:
    """Hold the linearised weak form of a recording against an envelope of its conditions.

    Args:
        recording: with the same constants and conditions.
        found: from current times cos(theta) to cart position.
        responses: that it covers.

    Raises:
        ValueError: the closed form cannot be made from this recording, is not consistent, or has no linearisation.
    """
    model = RTAC.from_rig(recording)
    closed = least_squares(model, recording, weak=True)
    missing = [n for n in ("eccentric_moment", "torque_constant") if n not in closed.estimates and n in model.free]
    if missing:
        reasons = f" ({next(iter(closed.skipped.values()))})" if closed.skipped else ""
        raise ValueError(f"no experiment shows {', '.join(missing)} in closed form{reasons}")
    loose = [
        f"{n} {100 * e.consistency:.0f} %"
        for n, e in closed.estimates.items()
        if n in _IN_RESPONSE and e.consistency >= CONSISTENT
    ]
    if loose:
        raise ValueError(
            f"its estimates scatter over the experiments by more than 30 % of their means ({', '.join(loose)}), as where dry "
            "friction holds the cart; hold a fitted model against the envelope instead (--model)"
        )
    system = linearise(closed.model, drive="current")
    response = np.asarray(system(1j * found.frequency))[0, 0]
    needed = np.abs(errors(response[None], found.nominal_response(), found.kind))[0] / found.weight_magnitude()
    mean = np.exp(np.mean(np.log(np.abs(responses.response)), axis=0))
    return ClosedFormCheck(closed.model, found.frequency, response, needed, np.abs(response) / mean)
