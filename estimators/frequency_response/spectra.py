"""The spectra of experiments whose input is of any kind, and the fits of responses to them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64
from scipy.signal.windows import hann

from estimators.frequency_response.batched_local_polynomial import local_responses
from estimators.frequency_response.local_polynomial import LocalFit, VanishingError, one_by_one
from estimators.frequency_response.periodic import Lines
from rtac_jax.measurement import Experiment

_EXCITED = 1e-3  # of the largest line, from which a line counts as excited when no band is given
_COMPILED = 500  # lines of all conditions, from which the compiled program pays for its start: 0.1 s of NumPy


class Spectra(NamedTuple):
    """The spectra that a local fit of one experiment takes."""

    experiment: Experiment
    into: Complex128[np.ndarray, "_bin"]
    out: Complex128[np.ndarray, "_bin"]
    lines: Float64[np.ndarray, "_line"]
    step: float  # between lines [rad/s]
    played: Float64[np.ndarray, "_sample"]


def spectra(
    experiment: Experiment, x: np.ndarray, y: np.ndarray, played: np.ndarray, band: tuple[float | int, float | int] | None,
    frequency: np.ndarray | None, half_width: int,
) -> Spectra:  # fmt: skip
    """Return the spectra of one experiment and the lines that are asked for: by default those that the input excites.

    Raises:
        ValueError: no line, or lines beyond half of the sampling rate.
    """
    spectrum, out = np.fft.rfft(x), np.fft.rfft(y)
    step = 2 * np.pi / (len(x) * experiment.sample_time)
    if frequency is not None:
        lines = frequency / step
    elif band is not None:
        if band[1] > (half := 0.5 / experiment.sample_time) * (1 + 1e-9):
            raise ValueError(
                f"band: is {band[0]:g} to {band[1]:g} Hz, and half of the sampling rate of {experiment.name} is {half:g} Hz; give "
                "Hz, not rad/s, up to there."
            )
        numbers = np.arange(1, len(spectrum))
        lines = numbers[(numbers * step >= 2 * np.pi * band[0] - 1e-9) & (numbers * step <= 2 * np.pi * band[1] + 1e-9)]
    else:
        size = np.abs(np.fft.rfft(played)[1:])
        lines = 1 + np.flatnonzero(size > _EXCITED * np.max(size))
        # Of noise single lines stick out beyond the band that it fills.
        silent = _silent(played, lines, len(spectrum), half_width)
        lines = lines if silent.all() else lines[~silent]
    if not len(lines) or np.min(lines) < 1 or np.max(lines) > len(spectrum) - 1:
        raise ValueError(
            f"/experiments/{experiment.name}: no line, or lines outside {step:.3g} to {step * (len(spectrum) - 1):.3g} rad/s, "
            "are asked for; change band or frequency."
        )
    return Spectra(experiment, spectrum, out, np.asarray(lines, dtype=np.float64), step, played)


def fit_lines(
    ready: Mapping[str, "Lines | Spectra"], half_width: int, degree: int, poles: int
) -> dict[str, Lines | ValueError]:
    """Fit all that is not fitted yet: in one compiled call where there are many lines, else by NumPy.

    An experiment whose input vanishes at a line has its error instead.
    """
    waiting = {name: one for name, one in ready.items() if isinstance(one, Spectra)}
    many = sum(len(one.lines) for one in waiting.values()) >= _COMPILED
    spectra = [(one.into, one.out, one.lines) for one in waiting.values()]
    together = local_responses if many else one_by_one
    fits = dict(zip(waiting, together(spectra, half_width=half_width, degree=degree, poles=poles), strict=True))
    found: dict[str, Lines | ValueError] = {}
    for name, one in ready.items():
        if not isinstance(one, Spectra):
            found[name] = one
            continue
        fit = fits[name]
        if isinstance(fit, VanishingError):
            found[name] = _vanishing(one.experiment, fit.line * one.step)
            continue
        try:
            found[name] = _judged(one, fit, half_width)
        except ValueError as error:
            found[name] = error
    return found


def _judged(one: Spectra, fit: LocalFit, half_width: int) -> Lines:
    """Return a local fit with its coherence.

    Raises:
        ValueError: the current itself vanishes around a line.
    """
    lines, bins = one.lines, len(one.into)
    near = _near(lines, bins, half_width)
    silent = _silent(one.played, lines, bins, half_width)
    if silent.any():
        raise _vanishing(one.experiment, float(lines[np.argmax(silent)]) * one.step)
    power = np.mean(np.abs(one.into[near]) ** 2, axis=1) * np.abs(fit.response) ** 2
    coherence = power / (power + fit.noise**2)
    return Lines(lines * one.step, fit.response, fit.std, fit.std, None, None, coherence, fit.freedom)


def _near(lines: np.ndarray, bins: int, half_width: int) -> np.ndarray:
    """Return the numbers of the lines in the window about each."""
    return np.clip(np.rint(lines).astype(np.int64)[:, None] + np.arange(-half_width, half_width + 1), 1, bins - 1)


def _silent(played: np.ndarray, lines: np.ndarray, bins: int, half_width: int) -> np.ndarray:
    """Return about which lines the input vanishes.

    cos(theta) spreads the current over all lines, so that what vanishes shows in the current itself, under a window from which
    little leaks where a period is cut.
    """
    current = np.abs(np.fft.rfft(played * hann(len(played), sym=False)))
    return np.max(current[_near(lines, bins, half_width)], axis=1) < _EXCITED * np.max(current[1:])


def _vanishing(experiment: Experiment, frequency: float) -> ValueError:
    return ValueError(
        f"/experiments/{experiment.name}: the excitation vanishes at {frequency:.4g} rad/s ({frequency / (2 * np.pi):.3g} Hz); "
        "excite that line, or narrow the band."
    )
