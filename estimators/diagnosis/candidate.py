"""The record of one candidate of a diagnosis."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from estimators.core.fit import Parameter
from estimators.diagnosis.policy import DiagnosisPolicy

_MOST = 0.5  # fraction of the misfit: what removes more explains most of it


@dataclasses.dataclass(frozen=True)
class Candidate:
    """The evidence on one effect of the candidate set.

    Attributes:
        id: of the effect.
        score: chi-square gained on the innovations of the base model, less the price of its amplitudes.
        chi_square: the same without that price; 20 and more, if not by the scatter of a few seconds, reject its absence.
        p_value: probability of so large a score by chance among all that were tried.
        detection_limit: amplitude that would be found, in the unit of its first amplitude parameter.
        unit: of it.
        testable: whether the data could show the effect at a plausible size.
        refitted: whether it was fitted together with the base model, and with effects named before it.
        bic_gain: by that; positive speaks for the effect.
        held_out_gain: in the log-likelihood of experiments that did not take part in estimating it; NaN where only one shows it.
        error_reduction: fraction of the misfit that it removes.
        parameters: of the effect after refitting.
        confusable_with: ids of accepted candidates that the data cannot tell from it.
        correlation: of its template with those of the others, by id.
    """

    id: str
    score: float
    chi_square: float
    p_value: float
    detection_limit: float
    unit: str
    testable: bool
    refitted: bool = False
    bic_gain: float = 0.0
    held_out_gain: float = 0.0
    error_reduction: float = 0.0
    parameters: Mapping[str, Parameter] = dataclasses.field(default_factory=dict)
    confusable_with: tuple[str, ...] = ()
    correlation: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def explains_most(self) -> bool:
        """Return whether a refit with the effect was worth its parameters and removed most of the misfit."""
        return self.refitted and self.bic_gain > 0 and self.error_reduction > _MOST

    @property
    def can_show(self) -> bool:
        """Return whether the data can show the effect, before or after it is fitted."""
        return self.testable or self.explains_most

    @property
    def deviations(self) -> dict[str, float]:
        """Return the standard deviations of the parameters that were estimated."""
        return {name: one.std for name, one in self.parameters.items() if not one.is_fixed}

    @property
    def limit(self) -> str:
        """Return the detection limit with its unit, a fraction in percent; empty where the data could not show the effect."""
        if not (self.testable and math.isfinite(self.detection_limit)):
            return ""
        fraction = self.unit == "1"
        return f"{(100 if fraction else 1) * self.detection_limit:.2g} {'%' if fraction else self.unit}"

    @property
    def limit_or_why(self) -> str:
        """Return the detection limit, or why there is none: random forces may stand for what shows only once it is fitted."""
        return self.limit or ("shows once fitted" if self.can_show else "not testable with these data")


def loudest(candidates: Sequence[Candidate], policy: DiagnosisPolicy) -> Candidate | None:
    """Return the largest of the candidates that are as large as an alarm and scatter over the seconds of data; None for none."""
    large = [c for c in candidates if c.chi_square >= policy.alarm and c.p_value >= policy.chance]
    return max(large, key=lambda c: c.chi_square, default=None)
