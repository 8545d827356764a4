"""Coloured sensor noise: its fraction and correlation time, as rest records show them, and its states in the filter.

Noise that wanders looks like a random force to a filter that expects it to be white, and then almost every effect of the
catalogue seems to help. So does noise whose colour is a little wrong: the colour of rest records comes from the likelihood of
their periodograms (P. Whittle, Arkiv foer Matematik 2, 1953), and the records of motion make it more exact (`Search.recoloured`).
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize
from scipy.special import expit, logit
from scipy.stats import chi2

from estimators.core.data import CHANNELS
from estimators.prediction_error.colour_limits import COLOUR_LIMITS, ColourLimits
from rtac_jax import RTAC
from rtac_jax.effects import Motion, Outputs, Sensor, States
from rtac_jax.measurement import Experiment
from rtac_jax.parameters import Scalar, parameter

Colours = dict[str, tuple[float, float]]
"""Fraction of coloured noise and its correlation time [s], by channel."""

_LAGS = 5  # of the correlations that have to be more than chance
_SHORTEST = 160  # samples of a rest record that tells anything
_CORRELATION_TIMES = (1.5, 5.0, 20.0)  # correlation times from which the likeliest is looked for, in samples
_RANGE = ((-6.0, 6.0), (-1.0, 6.0))  # of the logarithms of fraction over rest, and of the correlation time in samples
_REACH = (1.0, 0.3)  # first steps in the logarithms of fraction over rest, and of correlation time
_CLOSER = 0.5 ** np.arange(6)  # fractions of a step, tried where it leads to what cannot be
_MOST = 0.98  # the rest is white: quantisation at least


def _fraction() -> Any:
    return parameter(
        symbol="c", unit="1", bounds=(0.0, 1.0), meaning="fraction of the variance", fixed=True, default=0.0
    )


def _correlation_time() -> Any:
    return parameter(symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="correlation time", fixed=True, default=1e-3)


class ColourStates(Sensor):
    """The states of a predictor's model that carry first-order coloured noise in each output, beside the white.

    They are no effect of the rig: what is specified are `Colours`, and `with_colours` adds the states that stand for them.
    """

    id: ClassVar[str] = "coloured_noise"
    equation: ClassVar[str] = "y + n, tau n' = -n + w"
    source: ClassVar[str] = "Bryson and Johansen, IEEE Transactions on Automatic Control 10 (1965)"
    states: ClassVar[dict[str, str]] = {"cart_position": "m", "arm_velocity": "rad/s", "arm_angle": "rad"}
    closed: ClassVar[bool] = True

    cart_position_fraction: Scalar = _fraction()
    arm_velocity_fraction: Scalar = _fraction()
    arm_angle_fraction: Scalar = _fraction()
    cart_position_correlation_time: Scalar = _correlation_time()
    arm_velocity_correlation_time: Scalar = _correlation_time()
    arm_angle_correlation_time: Scalar = _correlation_time()

    @property
    def fraction(self) -> Any:
        """Fraction of the variance of each output's noise that is coloured, in the order of `CHANNELS`."""
        return jnp.stack([getattr(self, f"{channel}_fraction") for channel in CHANNELS])

    @property
    def correlation_time(self) -> Any:
        """Correlation time of each output's noise [s]."""
        return jnp.stack([getattr(self, f"{channel}_correlation_time") for channel in CHANNELS])

    def read(self, outputs: Outputs, own: States) -> Outputs:
        """Add the coloured noise to each output."""
        return Outputs(*(getattr(outputs, c) + own[list(self.states).index(c)] for c in Outputs._fields))

    def start(self, motion: Motion) -> States:
        """Return noise states of zero."""
        return (0.0 * motion.cart_position,) * len(self.states)

    def rate(self, motion: Motion, own: States) -> States:
        """Return the decay of each noise at its correlation time."""
        correlation_time = {c: getattr(self, f"{c}_correlation_time") for c in self.states}
        return tuple(-n / correlation_time[c] for c, n in zip(self.states, own, strict=True))

    def follow(self, motion: Motion, own: States) -> States:
        """Return the states after a step, decayed exactly."""
        return tuple(
            n * jnp.exp(-motion.step / getattr(self, f"{c}_correlation_time"))
            for c, n in zip(self.states, own, strict=True)
        )


def capped(colours: Colours) -> Colours:
    """Return the colours with some white noise left in each channel."""
    return {
        channel: (min(fraction, _MOST), correlation_time) for channel, (fraction, correlation_time) in colours.items()
    }


def with_colours(model: RTAC, colours: Colours) -> RTAC:
    """Return the model of a predictor whose sensors' noise has these colours; channels that are not named are white."""
    values = {}
    for channel, (fraction, correlation_time) in capped(colours).items():
        values |= {f"{channel}_fraction": fraction, f"{channel}_correlation_time": correlation_time}
    return model + ColourStates(**values) if values else model


@dataclasses.dataclass(frozen=True)
class RestSpectrum:
    """The periodograms of the rest records of a channel, which tell the colour of its noise.

    Attributes:
        angle: of each line, 2 pi frequency times sample time [rad].
        power: of each line, in any unit.
        interval: sample time [s].
    """

    angle: Float64[np.ndarray, " line"]
    power: Float64[np.ndarray, " line"]
    interval: float

    @classmethod
    def of(
        cls, experiments: Sequence[Experiment], channel: str, doubt: float = ColourLimits.doubt
    ) -> "RestSpectrum | None":
        """Compute them for records that are long enough and show a noise that is not white; None where there is none."""
        angle, power, products, count, interval = [], [], np.zeros(_LAGS + 1), 0, 0.0
        for e in experiments:
            if e.kind != "rest" or channel not in e.outputs or (interval and e.sample_time != interval):
                continue
            values = e.outputs[channel].values
            values = values - np.nanmean(values)
            values = np.where(np.isfinite(values), values, 0.0)
            samples = len(values)
            if samples < _SHORTEST or not np.any(values):
                continue
            lines = np.arange(1, (samples - 1) // 2 + 1)
            angle.append(2 * np.pi * lines / samples)
            power.append(np.abs(np.fft.rfft(values)[lines]) ** 2 / samples)
            products += [values[: samples - k] @ values[k:] for k in range(_LAGS + 1)]
            count, interval = count + samples, e.sample_time
        if not count or chi2.sf(count * np.sum((products[1:] / products[0]) ** 2), _LAGS) > doubt:
            return None
        return cls(np.concatenate(angle), np.concatenate(power), interval)

    def log_likelihood(self, fraction: float, correlation_time: float) -> float:
        """Return the log-likelihood of a fraction of coloured noise with this correlation time [s], at its best level."""
        keep = np.exp(-self.interval / correlation_time)
        shape = fraction * (1 - keep**2) / (1 - 2 * keep * np.cos(self.angle) + keep**2) + 1 - fraction
        return -float(len(shape) * np.log(np.mean(self.power / shape)) + np.sum(np.log(shape)))

    def colour(self) -> tuple[float, float]:
        """Return the likeliest fraction and correlation time [s]."""

        def cost(at: np.ndarray) -> float:
            return -self.log_likelihood(float(expit(at[0])), self.interval * float(np.exp(at[1])))

        begins = itertools.product((0.0, 3.0), np.log(_CORRELATION_TIMES))
        found = min(
            (minimize(cost, begin, method="L-BFGS-B", bounds=_RANGE) for begin in begins), key=lambda one: one.fun
        )
        return float(expit(found.x[0])), self.interval * float(np.exp(found.x[1]))


def rest_spectra(experiments: Sequence[Experiment], limits: ColourLimits = COLOUR_LIMITS) -> dict[str, RestSpectrum]:
    """Return the periodograms of the channels whose rest records are not white."""
    found = {channel: RestSpectrum.of(experiments, channel, limits.doubt) for channel in CHANNELS}
    return {channel: one for channel, one in found.items() if one is not None}


def colours_at_rest(experiments: Sequence[Experiment], limits: ColourLimits = COLOUR_LIMITS) -> Colours:
    """Estimate fraction and correlation time [s] of coloured noise, for channels whose rest records are not white."""
    found = {channel: one.colour() for channel, one in rest_spectra(experiments, limits).items()}
    return {
        channel: (fraction, correlation_time)
        for channel, (fraction, correlation_time) in found.items()
        if fraction > limits.little
    }


def likeliest_colours(first: Colours, likelihood: Callable[[Colours], float]) -> tuple[Colours, float]:
    """Climb the likelihood by parabolas through three points along each fraction and correlation time in turn.

    Returns the likeliest colours, and the log-likelihood that they gain over the first.
    """
    best, value = dict(first), likelihood(first)
    began = value
    for scale, channel, which in itertools.product((1.0, 0.5), first, (1, 0)):
        several: dict[float, Colours] = {}
        values: dict[float, float] = {}
        reach = 0.0
        for reach in scale * _REACH[which] * _CLOSER:
            several = {by: _moved(best, channel, which, by) for by in (-reach, reach)}
            values = {by: likelihood(colours) for by, colours in several.items()}
            if any(np.isfinite(one) for one in values.values()):
                break
        low, high = values[-reach], values[reach]
        bend = low - 2 * value + high
        if np.isfinite(bend) and bend < 0:
            top = float(np.clip(0.5 * reach * (low - high) / bend, -2 * reach, 2 * reach))
            several[top] = _moved(best, channel, which, top)
            values[top] = likelihood(several[top])
        by = max(values, key=lambda one: values[one])
        if values[by] > value:
            best, value = several[by], values[by]
    return best, value - began


def _moved(colours: Colours, channel: str, which: int, by: float) -> Colours:
    """Return the colours with the logit of a channel's fraction (0) or the logarithm of its correlation time (1) moved."""
    fraction, correlation_time = colours[channel]
    if which:
        return {**colours, channel: (fraction, correlation_time * float(np.exp(by)))}
    return {**colours, channel: (min(float(expit(logit(min(fraction, _MOST)) + by)), _MOST), correlation_time)}
