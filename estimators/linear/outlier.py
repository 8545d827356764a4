"""The one condition that differs from all others, and the fit of these that shows it."""

import math
from dataclasses import dataclass

from estimators.core.fit import Fit

# Residual over noise up to which a fit follows: noise read off a spectrum is 0.8 to 1.1 times the truth.
FOLLOWED = 1.3
# Residual over noise of one experiment, beyond which the model that follows all others does not follow it: as much as noise.
_NOT_FOLLOWED = math.sqrt(2)


@dataclass(frozen=True)
class Outlier:
    """The one condition that differs from all others.

    Attributes:
        name: of it.
        chi_square, freedom: of the differences between the others.
        fit: of the others; None where none was made.
        over_noise: what that leaves of the others at most, over the noise; NaN where none was made.
        left: what it leaves of this one at most, over the noise; NaN where none was made.
        channel: in which that is.
    """

    name: str
    chi_square: float
    freedom: int
    fit: Fit | None = None
    over_noise: float = math.nan
    left: float = math.nan
    channel: str = ""

    @property
    def decisive(self) -> bool:
        """Return whether one set of parameters was seen to follow all others, and not this one."""
        return self.over_noise <= FOLLOWED and self.left > _NOT_FOLLOWED

    @property
    def words(self) -> str:
        """Say which condition alone differs, and what to look at."""
        alike = (
            f"Without {self.name} next to nothing of the differences is left, and no more than chance makes (chi-square"
            f" {self.chi_square:.0f} on {self.freedom})"
        )
        if self.decisive:
            alike = (
                f"All experiments but {self.name} are followed to {self.over_noise:.2f} times the noise by one set of"
                f" parameters, which leaves {self.channel} of {self.name} at {rounded(self.left)} times the noise"
            )
        return (
            f"{alike}. Look at {self.name} first: at its sample time, at samples or counts that were lost, at a sensor that was set"
            " anew, at what touched the rig. Or it alone shows an effect that the model lacks: ask est.diagnose."
        )


def rounded(ratio: float) -> str:
    """Return a ratio in three figures, without an exponent."""
    return f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.3g}"
