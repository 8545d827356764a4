"""A linear plant with a controller in the loop, by code of its own."""

import numpy as np

from rtac_jax.measurement import Experiment


def looped(seed: int, gain: float, reference: float = 0.2) -> Experiment:
    """One condition of 1,500 samples of 20 ms, natural frequency 10 rad/s, damping ratio 0.05, integrated exactly."""
    random, step, (omega, damping) = np.random.default_rng(seed), 0.02, (10.0, 0.05)
    rate, swing = damping * omega, omega * np.sqrt(1 - damping**2)
    s, c = np.sin(swing * step), np.cos(swing * step)
    decay = np.exp(-rate * step)
    onward = decay * np.array([[c + rate / swing * s, s / swing], [-(omega**2) / swing * s, c - rate / swing * s]])
    state, held, position, current = np.zeros(2), 0.0, np.zeros(1500), np.zeros(1500)
    rest = np.array([1 / omega**2, 0.0])
    for k, (wanted, noise) in enumerate(
        zip(random.normal(0, reference, 1500), random.normal(0, 3e-3, 1500), strict=True)
    ):
        position[k] = state[0] + noise
        held += 0.5 * (position[k] - held)
        current[k] = wanted - gain * held
        state = rest * current[k] + onward @ (state - rest * current[k])
    return Experiment.of(
        f"run_{seed}", kind="forced", sample_time=step, current=current, cart_position=position, initial_arm_angle=0.0
    )
