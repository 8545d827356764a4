"""The rig's equations once more, for the peers: Table 1 of the paper, and equations (1) and (2) with a smooth sign of dry friction.

They are written so that NumPy, Numba and JAX can compute them.
"""

import numpy as np

STEP = 2e-3  # s
SMOOTH_CART, SMOOTH_ARM = 1e-3, 0.1  # m/s and rad/s, where the smooth sign turns
M, K, V, D, ME, J, KM, KV1, KV2 = 1.23, 132.6, 0.5543, 0.024, 1.06e-3, 9.5e-5, 0.0804, 1.39e-4, 1.49e-4
START = (0.02, 0.0, 0.0, 0.0)


def currents(steps: int, trajectories: int) -> np.ndarray:
    """Held currents [A], (steps, trajectories)."""
    return 0.34 * (np.random.default_rng(0).random((steps, trajectories)) - 0.5)


def slope(_t, x, current):
    """Equations (1) and (2), written again."""
    q, dq, angle, rate = x
    sine, cosine = np.sin(angle), np.cos(angle)
    sign = dq / np.sqrt(dq * dq + SMOOTH_CART * SMOOTH_CART)
    share = 0.5 * (1 + rate / np.sqrt(rate * rate + SMOOTH_ARM * SMOOTH_ARM))
    torque = KM * current - (KV2 + (KV1 - KV2) * share) * rate
    force = -K * q - V * dq - D * sign + ME * rate * rate * sine
    exchange = ME * cosine
    scale = 1 / (M * J - exchange * exchange)
    return (dq, (J * force - exchange * torque) * scale, rate, (M * torque - exchange * force) * scale)
