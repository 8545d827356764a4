"""The cost of a missing effect: envelopes about the model without and with it, and the gamma that each allows."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.frequency_response.response import FrequencyResponses
from estimators.uncertainty.envelope import Envelope, envelope
from rtac_jax import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.control import Actuation, Price, Units, nominal_plant, price

_LITTLE = 0.3  # |W T| that adds less than 5 % to a norm of 1


@dataclass(frozen=True, eq=False)
class EffectCost:
    """The envelopes of the same responses about a model without and with some effects; the result of `effect_cost`.

    Attributes:
        effects: names of the effects that only the second model has.
        before, after: envelopes about the linearised models, from current times cos(theta) [A] to cart position [m].
        price: gamma for the same demands on both, by "before" and "after", and the damping that can be asked for.
    """

    effects: tuple[str, ...]
    before: Envelope
    after: Envelope
    price: Price

    @property
    def gain(self) -> tuple[float, float, float]:
        """Frequency of the largest fall of the profile [rad/s], the model error there before, and |T| of the loop before."""
        at = int(np.argmax(self.before.profile - self.after.profile))
        omega, loop = float(self.before.frequency[at]), self.price.syntheses["before"]
        size = np.interp(omega, loop.frequency, np.abs(loop.complementary))
        return omega, float(self.before.profile[at]), float(size)

    def __str__(self) -> str:
        lines = [f"What leaving out {', '.join(self.effects) or 'nothing'} costs:"]
        for word, found in (("before", self.before), ("after", self.after)):
            at, gamma = int(np.argmax(found.profile)), self.price.gamma[word]
            lines.append(
                f"{word:6s}: the conditions lie up to {100 * found.profile[at]:.0f} % from the model, at {found.frequency[at]:.3g} "
                f"rad/s; gamma {gamma:.3f}{'' if gamma <= 1 else ', above 1: what is asked cannot be promised'}"
            )
        omega, error, size = self.gain
        lines.append(
            f"Most is gained at {omega:.3g} rad/s, where a controller made from the first model may have |T| = {1 / error:.2g} at "
            f"most; this one has {size:.2g}"
            + (", so its gamma hardly depends on it." if error * size < _LITTLE else ".")
        )
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw both profiles under their weights."""
        return draw(self)


@checked_arguments
def effect_cost(
    before: Fit | RTAC,
    after: Fit | RTAC,
    responses: FrequencyResponses,
    *,
    order_weight: int = 3,
    displacement: float = 0.015,
    torque_limit: float = 0.1,
) -> EffectCost:
    """Compute the envelope before and after an effect is added to a model, and gamma of one control problem for both.

    Each model, linearised about theta = 0, is the nominal one of an envelope about the same measured responses: what the
    model leaves out lies in the profile, and a controller has to be robust against it. What neither has, dry friction for
    instance, whose force has no linearisation, lies in both. The demands on the controller are those that the second
    envelope allows.

    Args:
        before: without the effect.
        after: with the effect, fitted to the same recording.
        responses: from current times cos(theta) [A] to cart position [m].
        order_weight: of both weights.
        displacement: from which the cart is to be brought to rest [m].
        torque_limit: of the motor [N m].

    Raises:
        ValueError: the responses are from or to another channel or not compensated, or as `linearise`, `envelope` and
            `price`.
        RuntimeError: `rtac_jax.configure()` was not called.
    """
    responses.require("current", "cart_position")
    models = {"before": _model(before), "after": _model(after)}
    found = {
        word: envelope(
            responses, nominal=_per_current(model), order_weight=order_weight, within_db=float("inf"), progress=False
        )
        for word, model in models.items()
    }
    last = models["after"]
    limit = Actuation.proposed(last, motor_limit=torque_limit).controller_limit / float(last["torque_constant"])
    return EffectCost(
        effects=tuple(name for name in last.ids if name not in models["before"].ids), **found,
        price=price({word: (one.nominal, one.weight) for word, one in found.items()}, limit, displacement=displacement),
    )  # fmt: skip


def _model(given: Fit | RTAC) -> RTAC:
    return given.model if isinstance(given, Fit) else given


def _per_current(model: RTAC) -> Any:
    return nominal_plant(model, units=Units(position=1.0, torque=1 / float(model["torque_constant"])))
