"""The parameters of Table 1 and the closed-form decay of the cart alone."""

import numpy as np

MASS, STIFFNESS, VISCOUS = 1.23, 132.6, 0.5543  # paper, section 4.2
DRY, INERTIA, MOMENT, TORQUE, ONWARD, BACK = 0.024, 9.5e-5, 1.06e-3, 0.0804, 1.39e-4, 1.49e-4  # and Table 1
TRUTH = {
    "spring_stiffness": STIFFNESS, "cart_viscous.coefficient": VISCOUS, "cart_coulomb.level": DRY,
    "eccentric_moment": MOMENT, "torque_constant": TORQUE, "arm_viscous.positive": ONWARD, "arm_viscous.negative": BACK,
}  # fmt: skip


def exact_decay(position: float, time: np.ndarray, dry: float = 0.0) -> np.ndarray:
    """A damped oscillator let go from rest, in closed form: from turn to turn it swings about +-d/k, until it sticks."""
    rate = VISCOUS / (2 * MASS)
    damped = np.sqrt(STIFFNESS / MASS - rate**2)
    found, begin = np.full_like(time, position), 0.0
    while abs(position) > dry / STIFFNESS and begin <= time[-1]:
        middle, after = np.copysign(dry / STIFFNESS, position), time - begin
        swing = np.exp(-rate * after) * (np.cos(damped * after) + rate / damped * np.sin(damped * after))
        found = np.where(after >= 0, middle + (position - middle) * swing, found)
        position = middle - (position - middle) * np.exp(-rate * np.pi / damped)
        begin += np.pi / damped
    return np.where(time >= begin, position, found)
