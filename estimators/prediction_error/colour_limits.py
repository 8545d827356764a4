"""The thresholds by which sensor noise at rest counts as coloured."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ColourLimits:
    """The limits from which on the noise of a channel counts as coloured.

    Attributes:
        doubt: p-value below which the noise of a rest record is not white.
        little: fraction of coloured noise that is not worth a state.
    """

    doubt: float = 2e-3
    little: float = 0.05


COLOUR_LIMITS = ColourLimits()
