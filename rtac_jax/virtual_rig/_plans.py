"""A set of plans that shows everything the paper's model can do, within the rig's travel."""

from dataclasses import replace
from typing import Literal

import numpy as np

from rtac_jax.measurement.plan import Plan

_BAND = (0.3, 8.0)  # [Hz], the multisine's lines
_CORNER = 1.7  # [Hz], near the resonance of the cart; above it the current falls
_RESONANCE = (1.5, 1.8)  # [Hz], where lines are larger, so that the cart moves by several millimetres


def multisine_current(random: np.random.Generator, samples: int, sample_time: float) -> np.ndarray:
    """Return a multisine of unit root mean square, (N,), with random phases between 0.3 and 8 Hz.

    The arm has no spring, so a line of amplitude a at angular frequency w swings it by a K_m / (J w^2):
    amplitudes grow with w^2, so that all lines swing the arm alike, up to the resonance of the cart, where
    they are largest, and fall with 1/w above it.
    """
    lines = np.arange(samples // 2 + 1) / (samples * sample_time)
    amplitude = np.where(lines < _CORNER, lines**2, _CORNER**3 / np.maximum(lines, _CORNER))
    amplitude[(lines < _BAND[0]) | (lines > _BAND[1])] = 0.0
    if not amplitude.any():
        raise ValueError("The experiment is too short, or sampled too slowly, for lines between 0.3 and 8 Hz.")
    amplitude[(lines >= _RESONANCE[0]) & (lines <= _RESONANCE[1])] *= 2.5
    spectrum = amplitude * np.exp(2j * np.pi * random.uniform(size=lines.size))
    wave = np.fft.irfft(spectrum, samples)
    return wave / wave.std()


def square_current(random: np.random.Generator, samples: int, sample_time: float) -> np.ndarray:
    """Return a square wave of unit amplitude, (N,), between 1.3 and 2.2 Hz by chance, starting in mid half-wave."""
    frequency = random.uniform(1.3, 2.2)
    return np.where((frequency * sample_time * np.arange(samples) + 0.25) % 1 < 0.5, 1.0, -1.0)


def standard_plans(
    *,
    seed: int,
    sample_time: float = 0.005,
    duration: float = 10.0,
    free: int = 4,
    forced: int = 8,
    rest: int = 1,
    repeats: int = 0,
    current_rms: float = 0.16,
    largest_current: float = 1.2,
    intersample: Literal["zoh", "foh", "bl"] = "zoh",
    played: Literal["zoh", "foh", "bl"] | None = None,
) -> list[Plan]:
    """Return free decays, forced runs, repeats of the first forced run, and rests, in this order.

    Free decays start at 5 to 15 mm, on alternating sides, the arm free at various angles. Forced runs start
    at various places of cart and arm; three of four are multisines, the fourth a square wave; their amplitude
    goes from 50 to 100 % of the largest (section 5.3). On the paper's rig the cart stays within 15 mm, the
    arm below 60 rad/s and the torque below 0.1 N m.

    Args:
        seed: of starting places and phases.
        sample_time: [s].
        duration: of each free or forced run [s]; a rest takes 2 s, or this if it is shorter.
        free: number of free decays.
        forced: number of forced runs.
        rest: number of rests.
        repeats: number of further runs with the first forced run's input and start.
        current_rms: of the largest multisine [A]; it is the amplitude of the largest square wave too.
        largest_current: multisines are clipped there [A]; the default is 0.1 N m on the paper's rig.
        intersample: what the recording says of the inputs between samples.
        played: what they really do; None is what the recording says.

    Raises:
        ValueError: a negative number of plans, repeats of nothing, or a duration too short for the multisine.
    """
    if min(free, forced, rest, repeats) < 0:
        raise ValueError("free, forced, rest and repeats must not be negative.")
    if repeats and not forced:
        raise ValueError("repeats repeat the first forced run; ask for at least one forced run.")
    random = np.random.default_rng(seed)
    samples = round(duration / sample_time)
    plans = []
    for n in range(free):
        plans.append(
            Plan(
                f"free_{n + 1}",
                "free",
                duration,
                sample_time,
                initial_position=float(np.linspace(0.015, 0.005, free)[n] * (-1) ** n),
                initial_angle=float(random.uniform(-np.pi, np.pi)),
            )
        )
    runs = []
    for n in range(forced):
        size = current_rms * (0.5 + 0.5 * (n + 1) / forced)
        if n % 4 == 3:
            current = size * square_current(random, samples, sample_time)
        else:
            current = np.clip(size * multisine_current(random, samples, sample_time), -largest_current, largest_current)
        runs.append(
            Plan(
                f"forced_{n + 1}",
                "forced",
                duration,
                sample_time,
                current,
                initial_position=float(random.uniform(-0.01, 0.01)),
                initial_angle=float(random.uniform(-np.pi, np.pi)),
                intersample=intersample,
                played=played,
            )
        )
    again = [replace(runs[0], name=f"repeat_{n + 1}", repeat_of=runs[0].name) for n in range(repeats)]
    short = min(2.0, duration)
    return plans + runs + again + [Plan(f"rest_{n + 1}", "rest", short, sample_time) for n in range(rest)]
