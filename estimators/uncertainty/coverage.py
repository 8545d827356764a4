"""Coverage: the probability that a new condition lies inside an envelope, from how many were inside so far."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.special


@dataclass(frozen=True)
class Coverage:
    """A statement of coverage at all frequencies of the grid at once.

    With `confidence`, a new condition lies inside with at least `probability`. The statement holds for conditions drawn
    independently from the same population as those of the envelope.

    Attributes:
        conditions: that the statement rests on.
        confidence: [1].
        probability: lower bound [1].
        method: "held out" (conditions that took no part in the fit, see `held_out_coverage`) or "scenario" (those that were
            fitted, see `scenario_coverage`).
        supports: conditions that alone determine the envelope, for "scenario".
        raised: factor by which the weight was raised to cover those held out [1].
    """

    conditions: int
    confidence: float
    probability: float
    method: Literal["held out", "scenario"]
    supports: int | None = None
    raised: float = 1.0

    def __str__(self) -> str:
        what = f"{self.conditions} conditions " + (
            "held out" if self.method == "held out" else f"fitted, {self.supports} of which determine the envelope"
        )
        sure = f"{100 * self.confidence:.0f} % confidence"
        if self.probability < 0.005:
            return f"nothing can be said of a new condition with {sure} ({what}); hold some out, or record more"
        return f"with {sure} a new condition lies inside with a probability of at least {100 * self.probability:.1f} % ({what})"


def held_out_coverage(count: int, *, confidence: float = 0.95, raised: float = 1.0) -> Coverage:
    """State the coverage from conditions that took no part in the fit.

    All of them lie inside a weight that was raised where it had to be. How far each lies out is one number, and the
    weight covers at least the largest of `count` independent ones; the probability below the largest of n draws exceeds
    p with probability 1 - p^n, whatever the distribution (Wilks 1941).
    """
    return Coverage(count, confidence, float((1 - confidence) ** (1 / count)), "held out", raised=raised)


def scenario_coverage(count: int, supports: int, *, confidence: float = 0.95) -> Coverage:
    """State the coverage from the fitted conditions alone, `supports` of which would give the same envelope.

    Source: Campi, Garatti and Ramponi (2018), A general scenario theory for nonconvex optimization and decision making,
    IEEE Transactions on Automatic Control 63, theorem 1.
    """
    if supports >= count:
        return Coverage(count, confidence, 0.0, "scenario", supports)
    choose = scipy.special.gammaln(count + 1) - scipy.special.gammaln(supports + 1)
    choose -= scipy.special.gammaln(count - supports + 1)
    log_ratio = np.log(1 - confidence) - np.log(count) - choose
    return Coverage(count, confidence, float(np.exp(log_ratio / (count - supports))), "scenario", supports)
