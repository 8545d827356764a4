"""Small experiments with one channel each, and ways to spoil them."""

import numpy as np

from rtac_jax.measurement import (
    Experiment,
)

DT = 2e-3
T = np.arange(2000) * DT
DECAY = 15e-3 * np.exp(-0.3 * T) * np.cos(10.4 * T)


def noise(seed, std=1e-5):
    return std * np.random.default_rng(seed).standard_normal(len(T))


def free(name="free", **options):
    given = {"kind": "free", "sample_time": DT, "cart_position": DECAY, **options}
    return Experiment.of(name, **given)


def forced(name="forced", **options):
    given = {"current": np.sin(8 * T), "arm_velocity": np.sin(8 * T + 1), "cart_position": DECAY}
    return Experiment.of(name, **{"kind": "forced", "sample_time": DT, **given, **options})


def rest(name="rest"):
    return Experiment.of(name, kind="rest", sample_time=DT, cart_position=noise(0), arm_velocity=0 * T)


def spoilt(values, index, value):
    values = np.array(values)
    values[index] = value
    return values
