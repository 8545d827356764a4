"""Noise of a measured current, seen where nothing drives."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from ._experiment import Experiment

# Of a current that looks like noise: its rms over that of those that drive (a shunt and a 12-bit converter leave some percent), its
# mean in deviations of a mean, and its levels (a random binary sequence has two, quantised noise of a converter seldom fewer).
_SMALL_CURRENT, _CHANCE_OF_MEAN, _FEW_LEVELS = 0.1, 5.0, 3


def current_noise(experiments: Sequence[Experiment]) -> dict[str, float]:
    """Return the rms of a current that looks like the noise of a measured one, by name of an experiment that is not forced [A].

    It does where its mean is what chance leaves of it, a sample tells next to nothing of the one after it, it has many levels, and
    all of it is small beside what drives forced experiments.
    """
    currents = {e.name: e.inputs["current"].values for e in experiments if "current" in e.inputs}
    size = {name: float(np.sqrt(np.mean(values**2))) for name, values in currents.items()}
    driven = [size[e.name] for e in experiments if e.kind == "forced" and e.name in size]
    most = _SMALL_CURRENT * max(driven, default=0.0)
    return {
        e.name: size[e.name]
        for e in experiments
        if e.kind != "forced"
        and 0.0 < size.get(e.name, 0.0) <= most
        and _looks_like_noise(currents[e.name], size[e.name])
    }


def noise_level(noisy: dict[str, float]) -> float:
    """Return the root mean square of the noise that experiments show [A]; zero if none does."""
    return float(np.sqrt(np.mean(np.square(list(noisy.values()))))) if noisy else 0.0


def _looks_like_noise(values: Float64[np.ndarray, " sample"], size: float) -> bool:
    """Return whether samples scatter about zero with no memory and on many levels, as a random binary sequence does not."""
    # The mean of n independent samples is their deviation over the root of n; neighbours differ by the root of two times it.
    about_zero = abs(float(np.mean(values))) <= _CHANCE_OF_MEAN * size / np.sqrt(len(values))
    return about_zero and float(np.std(np.diff(values))) > size and len(np.unique(values)) > _FEW_LEVELS
