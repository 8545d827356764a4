"""Correlations of estimated parameters, and the ellipses of any two of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.core.drawing import draw

_WELL = 0.05  # std over value below which a parameter is known well, whatever it is correlated with: a twentieth
_STRONG = 0.9  # |correlation| from which on two parameters can hardly be told apart; as for effects (README, `confusable_with`)


@dataclass(frozen=True, eq=False)
class ParameterCorrelations:
    """The correlations of a fit's free shared parameters.

    Attributes:
        names, units: of the parameters.
        values: the estimates, SI units.
        covariance: of the estimates.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]

    @property
    def std(self) -> Float[np.ndarray, " parameter"]:
        """Return the standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def matrix(self) -> Float[np.ndarray, "parameter parameter"]:
        """Correlation of every two parameters [1]."""
        return self.covariance / np.outer(self.std, self.std)

    def ellipse(
        self, first: str, second: str, *, sigmas: float = 2.0, points: int = 100
    ) -> Float[np.ndarray, "2 point"]:
        """Return the points of the ellipse on which two parameters lie so many standard deviations from the estimate.

        With two sigmas it holds both with a probability of 1 - exp(-2) = 86 %; its projections, each alone with 95 %.

        Args:
            first: name of the parameter along the first row of the result.
            second: name of that along the second row.
            sigmas: standard deviations.
            points: number of points.

        Raises:
            ValueError: a name is not among the free parameters.

        Source: Ljung, System Identification (1999), section 9.4.
        """
        for name in (first, second):
            if name not in self.names:
                raise ValueError(f"{name!r} is not among the free parameters: {', '.join(self.names)}.")
        places = [self.names.index(first), self.names.index(second)]
        return self.values[places][:, None] + ellipse(self.covariance[np.ix_(places, places)], sigmas, points)

    def strongest(self) -> tuple[str, str, float] | None:
        """Return the two parameters that are most strongly correlated, and their correlation; None for one parameter."""
        if len(self.names) < 2:
            return None
        off = self.matrix - np.eye(len(self.names))
        i, j = np.unravel_index(np.argmax(np.abs(off)), off.shape)
        return self.names[int(i)], self.names[int(j)], float(off[i, j])

    def __str__(self) -> str:
        width = max((len(name) for name in self.names), default=0)
        lines = [f"{'correlation':{width}s} " + " ".join(f"{n + 1:6d}" for n in range(len(self.names)))]
        for n, (name, row) in enumerate(zip(self.names, self.matrix, strict=True)):
            lines.append(f"{name:{width}s} " + " ".join(f"{value:6.2f}" for value in row[: n + 1]))
        return "\n".join([*lines, f"{self.verdict}."])

    @property
    def verdict(self) -> str:
        """Return the two parameters that the data tell apart worst, in words."""
        found = self.strongest()
        if found is None:
            return "One parameter is free"
        first, second, value = found
        if abs(value) < _STRONG:
            return f"No two parameters are correlated by more than {abs(value):.2f}"
        said = f"{first} and {second} are correlated by {value:.3f}: "
        places = [self.names.index(first), self.names.index(second)]
        loose = float(np.max(self.std[places] / np.maximum(np.abs(self.values[places]), 1e-300)))
        if loose < _WELL:
            common = "ratio" if value > 0 else "product"
            return f"{said}their {common} is known better than each alone, which is known to {100 * loose:.2g} %"
        return f"{said}these data hardly tell them apart"

    def plot(self) -> Any:
        """Draw the two-sigma ellipse of every two parameters, and their correlations."""
        return draw(self)


def ellipse(
    covariance: Float[np.ndarray, "2 2"], sigmas: float = 2.0, points: int = 100
) -> Float[np.ndarray, "2 point"]:
    """Return the points about zero that lie so many standard deviations away."""
    size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    angle = np.linspace(0, 2 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return sigmas * size[:, None] * (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle))
