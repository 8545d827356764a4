"""A rig recorded in several operating conditions, for the commands that lead from conditions to a controller."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
from command_line import call, refused

from rtac_jax.measurement import Recording, from_rest, harmonic_grid, multisine
from rtac_jax.virtual_rig import Plan, Rig, record

RIG = Rig(position_noise=2e-6, quantisation_bits=16, encoder=True)
SAMPLE_TIME, SAMPLES, CONDITIONS = 0.01, 2000, 6


def plans():
    """Arms that start within 45 degrees of where they push most, with a multisine of their own at three amplitudes."""
    random = np.random.default_rng(1)
    harmonics = harmonic_grid("all", period=SAMPLES, sample_time=SAMPLE_TIME, band=(1.0, 6.0))
    ratio = harmonics / (SAMPLES * SAMPLE_TIME * 1.7)  # of the frequency to that of the resonance
    amplitudes = np.minimum(ratio**2, 1 / ratio)
    found = []
    for n in range(CONDITIONS):
        wave = multisine(
            samples=SAMPLES, sample_time=SAMPLE_TIME, rms=0.12 * (1, 0.75, 0.5)[n % 3], harmonics=[int(h) for h in harmonics],
            amplitudes=amplitudes, seed=n,
        )  # fmt: skip
        angle = float(random.uniform(-0.8, 0.8)) + (np.pi if n % 2 else 0.0)
        duration = SAMPLES * SAMPLE_TIME
        found.append(Plan(f"condition_{n + 1}", "forced", duration, SAMPLE_TIME, from_rest(wave), initial_angle=angle))
    free = Plan("free_1", "free", 6.0, SAMPLE_TIME, initial_position=0.015, initial_angle=0.5)
    return [*found, free, Plan("rest_1", "rest", 2.0, SAMPLE_TIME)]


@functools.cache
def recorded() -> Recording:
    return record(RIG, plans(), seed=1, step=1e-3)


def saved(folder: Path) -> Path:
    recorded().save(folder / "rig.h5")
    return folder / "rig.h5"


@functools.cache
def smooth() -> Recording:
    """Small motions of a rig without dry friction."""
    lines = [int(h) for h in harmonic_grid("all", period=1000, sample_time=0.02, band=(1.0, 6.0))]
    plans = [
        Plan(
            f"condition_{n + 1}", "forced", 20.0, 0.02,
            from_rest(multisine(samples=1000, sample_time=0.02, rms=0.01, harmonics=lines, seed=n)), initial_angle=0.3 * n,
        )
        for n in range(4)
    ]  # fmt: skip
    return record(replace(RIG, cart_coulomb=0.0), plans, seed=1, step=1e-3)


def check_refusals(command: str, folder: Path) -> None:
    """Too few conditions do not allow either command, and a file that cannot be read is wrong use."""
    recorded().select(["condition_1", "rest_1"]).save(folder / "one.h5")
    refused(call(command, folder / "one.h5"), 1, "only condition_1", "two conditions")
    recorded().select(["free_1", "rest_1"]).save(folder / "none.h5")
    refused(call(command, folder / "none.h5"), 1, "no experiment shows")
    refused(call(command, folder / "missing.h5"), 2, "missing.h5")
