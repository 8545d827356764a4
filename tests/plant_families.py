"""Families of plants about a nominal one that is known, and their responses."""

import control as ct
import numpy as np

OMEGA = np.geomspace(1.0, 100.0, 100)
# Two modes and zeros on both sides, as the paper's P_0.
NOMINAL = ct.tf([0.3, 10.0, -20.0, 4000.0], np.polymul([1, 5.4, 174.0], [1, 8.2, 1415.0]))
WEIGHT = ct.tf([0.4, 4.0], [1.0, 30.0])


def at(system, omega=OMEGA):
    return np.polyval(system.num[0][0], 1j * omega) / np.polyval(system.den[0][0], 1j * omega)


def mode(gain, frequency, damping, gain_2=0.15, frequency_2=37.4):
    """Two modes, the second smaller."""
    return ct.tf([gain], [1 / frequency**2, 2 * damping / frequency, 1]) + ct.tf(
        [gain * gain_2], [1 / frequency_2**2, 0.2 / frequency_2, 1]
    )


def draw(count, seed, spread=1.0):
    random = np.random.default_rng(seed)
    u = spread * random.uniform(-1, 1, (count, 4))
    return [mode(1 + 0.2 * a, 12.9 * (1 + 0.05 * b), 0.2 * (1 + 0.3 * c), 0.15 * (1 + 0.3 * d)) for a, b, c, d in u]


def responses(systems, omega=OMEGA):
    return np.array([at(system, omega) for system in systems])
