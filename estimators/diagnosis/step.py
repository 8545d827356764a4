"""One step of a selection: an effect that improved the model."""

import dataclasses

from estimators.diagnosis.evidence import FittedModel
from estimators.misspecification.adequacy import AdequacyTest


@dataclasses.dataclass(frozen=True)
class Step:
    """One effect that improved the model.

    Attributes:
        id: of the effect.
        rivals: ids that the data cannot tell from it.
        gain: twice the gain in log-likelihood over the model before.
        bic_gain: the same less the price of its parameters.
        held_out_gain: in the log-likelihood of experiments that did not take part in estimating it; NaN where only one shows it.
        model: the model with it.
        left: the tests of the model with it.
        amplitudes: names of its parameters that make its size.
        late: those of the rivals that were not fitted in its place before the time was over.
    """

    id: str
    rivals: tuple[str, ...]
    gain: float
    bic_gain: float
    held_out_gain: float
    model: FittedModel
    left: tuple[AdequacyTest, ...]
    amplitudes: tuple[str, ...] = ()
    late: tuple[str, ...] = ()
