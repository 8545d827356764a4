"""Plain records of what the innovations of one model say: scores of candidates and tests of adequacy, without any verdict.

Nothing here or in what reads these records needs a model, so that what was computed can be judged again from a file.
"""

import dataclasses
import math
from typing import Protocol, runtime_checkable

from scipy.stats import f as fisher

_ONCE, _TWICE = ", that of the mains", ", twice that of the mains"
_MAINS, _MAINS_WITHIN = {50.0: _ONCE, 60.0: _ONCE, 100.0: _TWICE, 120.0: _TWICE}, 0.3  # Hz


@runtime_checkable
class Scored(Protocol):
    """A candidate of one shape with its score."""

    @property
    def id(self) -> str:
        """Return the id of the effect."""
        ...

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Its amplitude parameters."""
        ...

    @property
    def statistic(self) -> float:
        """Chi-square distributed when the effect is absent."""
        ...

    @property
    def p_value(self) -> float:
        """Return the p-value by the model's variance or by the scatter over seconds of data, whichever is larger."""
        ...


@dataclasses.dataclass(frozen=True)
class Score:
    """The score of one candidate of one shape against the innovations of a model.

    Attributes:
        id: of the effect.
        shape: place among all scores against the same innovations.
        amplitudes: its amplitude parameters.
        statistic: chi-square distributed when the effect is absent; zero where the sign is unphysical.
        p_value: by the model's variance or by the scatter over seconds of data, whichever is larger.
        begin: values of the amplitudes at which to begin to fit them.
    """

    id: str
    shape: int
    amplitudes: tuple[str, ...]
    statistic: float
    p_value: float
    begin: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class StaticForce:
    """The explanation by a force at a port as a function of one variable.

    Attributes:
        port: "cart" or "arm".
        variable: that it depends on.
        p_value: for this curve alone.
        excess: twice the gain in log-likelihood, less what chance explains.
    """

    port: str
    variable: str
    p_value: float
    excess: float


@dataclasses.dataclass(frozen=True)
class LaggedForce:
    """The explanation by a force at a port that follows one signal with a lag.

    Attributes:
        port: "cart" or "arm".
        follows: the signal.
        p_value: for this signal alone.
        excess: twice the gain in log-likelihood, less what chance explains.
    """

    port: str
    follows: str
    p_value: float
    excess: float


@dataclasses.dataclass(frozen=True)
class ParameterDrift:
    """The explanation by a parameter that changes steadily within experiments.

    Attributes:
        parameter: name of it.
        rate: of its change, in its unit per second.
        std: of that.
        value: of the parameter in the fit, for all times.
        unit: of the parameter.
        p_value: for this parameter alone.
        excess: twice the gain in log-likelihood, less what chance explains.
    """

    parameter: str
    rate: float
    std: float
    value: float
    unit: str
    p_value: float
    excess: float


@dataclasses.dataclass(frozen=True)
class SpectralLine:
    """The strongest line of the innovations' spectrum.

    Attributes:
        channel: where it shows.
        frequency: of it [rad/s].
        ratio: power over that of the noise around.
        excess: of the line over the noise, in units of twice the log-likelihood.
        p_value: of so strong a line among all by chance.
    """

    channel: str
    frequency: float
    ratio: float
    excess: float
    p_value: float

    @property
    def in_hertz(self) -> str:
        """Return its frequency in Hz, and whether that is near that of the mains, or twice that."""
        hertz = self.frequency / (2 * math.pi)
        said = next((words for one, words in _MAINS.items() if abs(hertz - one) < _MAINS_WITHIN), "")
        return f"{hertz:.3g} Hz{said}"


@dataclasses.dataclass(frozen=True)
class RepeatTest:
    """The part of the misfit that comes back in every repeat of one experiment, beside what differs.

    Attributes:
        ratio: mean square of what all repeats share over that of their differences; one where the model is right.
        freedom: degrees of freedom of both, as the autocorrelation of the differences leaves them.
        p_value: of so large a ratio by chance.
        power: mean square of what all repeats share beyond noise, slower than a few samples, where the model states one.
        repeats: number of experiments.
        part: of all measured values, that these have.
        shared: model error beyond noise in the repeats, in units of twice the log-likelihood.
    """

    ratio: float
    freedom: tuple[float, float]
    p_value: float
    power: float
    repeats: int
    part: float
    shared: float

    @property
    def excess(self) -> float:
        """Return the same of all data, if it is as large in each; zero where chance left less than noise does."""
        return max(self.shared, 0.0) / self.part


@dataclasses.dataclass(frozen=True)
class Findings:
    """Everything that the tests of the innovations of one model computed.

    Attributes:
        scores: of every candidate in every shape.
        curves: of a force that depends on one variable.
        lagged: of a force that follows one signal with a lag.
        line: the strongest line of the spectrum; None where experiments are too short.
        repeats: None where no experiment repeats another.
        drifts: of each free parameter within experiments.
    """

    scores: tuple[Score, ...] = ()
    curves: tuple[StaticForce, ...] = ()
    lagged: tuple[LaggedForce, ...] = ()
    line: SpectralLine | None = None
    repeats: RepeatTest | None = None
    drifts: tuple[ParameterDrift, ...] = ()


@dataclasses.dataclass(frozen=True)
class CriticalValues:
    """Thresholds from which on a test rejects.

    Attributes:
        alarm: chi-square of a candidate's score.
        chance: probability of an alarm by any of the candidates that are tried, if nothing is missing.
        level: probability that any of all tests rejects, if nothing is missing.
    """

    alarm: float
    chance: float
    level: float

    def of_few(self, stretches: int, tried: int) -> float:
        """Return the critical chi-square of one amplitude, which is larger where few stretches of time tell their scatter.

        Args:
            stretches: of time.
            tried: candidates.
        """
        if stretches < 3:
            return self.alarm
        least = float(fisher.isf(self.chance / tried, 1, stretches - 1)) * stretches / (stretches - 1)
        return max(self.alarm, least)
