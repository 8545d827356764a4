"""Sensor noise with a memory: how much of it, and how long, as rest records show it, and what the filter makes of it.

Noise that wanders looks like a random force to a filter that expects it to be white, and then almost every effect of the
catalogue seems to help.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from estimators._problem import CHANNELS
from rtac_jax._parameter import Scalar, parameter
from rtac_jax.effects import Motion, Outputs, Sensor, States
from rtac_jax.measurement import Experiment

_LAGS = 40
_DOUBT = 1e-4  # p-value below which the noise of a rest record is not white
_MOST = 0.98  # the rest is white: quantisation at least


def _share() -> Any:
    return parameter(symbol="c", unit="1", bounds=(0.0, 1.0), meaning="share of the variance", fixed=True, default=0.0)


def _memory() -> Any:
    return parameter(symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="correlation time", fixed=True, default=1e-3)


class ColouredNoise(Sensor):
    """First-order coloured noise in each output, beside the white; no effect of the rig, so not in the catalogue."""

    id: ClassVar[str] = "coloured_noise"
    equation: ClassVar[str] = "y + n, tau n' = -n + w"
    source: ClassVar[str] = "Bryson and Johansen, IEEE Transactions on Automatic Control 10 (1965)"
    states: ClassVar[dict[str, str]] = {"cart_position": "m", "arm_velocity": "rad/s", "arm_angle": "rad"}
    closed: ClassVar[bool] = True

    cart_position_share: Scalar = _share()
    arm_velocity_share: Scalar = _share()
    arm_angle_share: Scalar = _share()
    cart_position_memory: Scalar = _memory()
    arm_velocity_memory: Scalar = _memory()
    arm_angle_memory: Scalar = _memory()

    @classmethod
    def of(cls, colours: dict[str, tuple[float, float]]) -> "ColouredNoise":
        """From share and correlation time [s] by channel; channels that are not named are white."""
        values = {}
        for channel, (share, memory) in colours.items():
            values |= {f"{channel}_share": min(share, _MOST), f"{channel}_memory": memory}
        return cls(**values)

    @property
    def share(self) -> Any:
        """Share of the variance of each output's noise, in the order of `CHANNELS`."""
        return jnp.stack([getattr(self, f"{channel}_share") for channel in CHANNELS])

    @property
    def memory(self) -> Any:
        """Correlation time of each output's noise [s]."""
        return jnp.stack([getattr(self, f"{channel}_memory") for channel in CHANNELS])

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return Outputs(*(getattr(outputs, c) + own[list(self.states).index(c)] for c in Outputs._fields))

    def start(self, motion: Motion) -> States:
        return (0.0 * motion.cart_position,) * len(self.states)

    def rate(self, motion: Motion, own: States) -> States:
        memory = {c: getattr(self, f"{c}_memory") for c in self.states}
        return tuple(-n / memory[c] for c, n in zip(self.states, own, strict=True))

    def follow(self, motion: Motion, own: States) -> States:
        return tuple(
            n * jnp.exp(-motion.step / getattr(self, f"{c}_memory")) for c, n in zip(self.states, own, strict=True)
        )


def colours_at_rest(experiments: Sequence[Experiment]) -> dict[str, tuple[float, float]]:
    """Share of coloured noise and its correlation time [s], for channels whose rest records are not white."""
    found = {}
    for channel in CHANNELS:
        records = [e for e in experiments if e.kind == "rest" and channel in e.outputs]
        products, count, interval = np.zeros(_LAGS + 1), 0, 0.0
        for e in records:
            values = e.outputs[channel].values
            values = values - np.nanmean(values)
            values = np.where(np.isfinite(values), values, 0.0)
            if len(values) < 4 * _LAGS or not np.any(values):
                continue
            products += [values[: len(values) - k] @ values[k:] for k in range(_LAGS + 1)]
            count, interval = count + len(values), e.sample_time
        if not count:
            continue
        correlation = products[1:] / products[0]
        if chi2.sf(count * np.sum(correlation[:5] ** 2), 5) > _DOUBT:
            continue
        lags = np.arange(1, _LAGS + 1)
        best = (np.inf, 0.0, 0.0)
        for keep in 1.0 - np.geomspace(0.01, 0.9, 60):
            shape = keep**lags
            share = float(np.clip(shape @ correlation / (shape @ shape), 0.0, 1.0))
            best = min(best, (float(np.sum((correlation - share * shape) ** 2)), share, float(keep)))
        _, share, keep = best
        if share > 0.05:
            found[channel] = (share, -interval / np.log(keep))
    return found
