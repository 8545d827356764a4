"""Attribution of the model error between plants and nominal model, at each frequency."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from estimators.uncertainty.uncertainty_structures import Kind, Nominal, Plants, errors, slopes
from rtac_jax.renamed import renamed

Curve = Float64[np.ndarray, " frequency"]
SOURCES = ("unmodelled", "amplitude", "scatter", "estimation")


@dataclass(frozen=True, eq=False)
class Attribution:
    """The root mean squares over conditions, in the unit of the model error; their squares sum to its mean square.

    Attributes:
        unmodelled: of the mean condition: what the nominal model's order, or its minimax compromise, leaves.
        amplitude: what follows the input's amplitude linearly, beyond chance.
        scatter: what else differs between conditions.
        estimation: what the standard deviations of the responses explain; zero where none were given.
    """

    unmodelled: Curve
    amplitude: Curve
    scatter: Curve
    estimation: Curve

    shares = renamed("shares", "fractions")

    @property
    def fractions(self) -> Float64[np.ndarray, "source frequency"]:
        """Fraction of the mean squared model error [1] in the order of `SOURCES`."""
        squares = np.stack([getattr(self, name) ** 2 for name in SOURCES])
        return squares / np.maximum(squares.sum(axis=0), 1e-300)

    def largest(self) -> tuple[str, ...]:
        """Return the name of the largest source at each frequency."""
        return tuple(SOURCES[i] for i in np.argmax(self.fractions, axis=0))


def attribute(
    plants: Plants,
    nominal: Nominal,
    kind: Kind,
    *,
    std: Float64[np.ndarray, "condition frequency"] | None = None,
    amplitude: Float64[np.ndarray, " condition"] | None = None,
) -> Attribution:
    """Split the mean squared model error by its sources.

    The mean is unmodelled dynamics; of the scatter about it, a straight line in the amplitude takes its part, less what
    it would take by chance; of the rest, the estimation's variance is taken off, and scatter is what remains.
    """
    model_error = errors(plants, nominal, kind)
    count = len(model_error)
    mean = model_error.mean(axis=0)
    spread = np.mean(np.abs(model_error - mean) ** 2, axis=0)
    by_amplitude = np.zeros_like(spread)
    if amplitude is not None and count > 3 and np.ptp(amplitude) > 1e-9 * np.max(np.abs(amplitude)):
        away = amplitude - amplitude.mean()
        slope = away @ model_error / (away @ away)
        explained = np.abs(slope) ** 2 * (away @ away) / count
        chance = (spread - explained) / (count - 2)
        by_amplitude = np.maximum(explained - chance, 0.0)
    estimation = np.zeros_like(spread)
    if std is not None:
        # To first order an error of the plant shifts the model error by its relative size times what a shift of the nominal does.
        estimation = np.mean((np.abs(slopes(plants, nominal, kind)) * std / np.abs(plants)) ** 2, axis=0)
        if kind == "additive":
            estimation = np.mean(std**2, axis=0)
    estimation = np.minimum(estimation, spread - by_amplitude)
    rest = np.maximum(spread - by_amplitude - estimation, 0.0)
    return Attribution(np.abs(mean), np.sqrt(by_amplitude), np.sqrt(rest), np.sqrt(np.maximum(estimation, 0.0)))


SOURCE_WORDS = {
    "unmodelled": "left by the nominal model",
    "amplitude": "amplitude of the input",
    "scatter": "scatter between conditions",
    "estimation": "noise of the estimates",
}
