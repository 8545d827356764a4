"""A positioning axis in closed loop, simulated by code of its own: inertia, viscous and dry friction, an offset of the drive.

Steps of 20 us, semi-implicit. Dry friction is a steep function of the speed, as that of lubricated guides: the axis creeps where it
seems to rest, which the model's dry friction does not, and the encoder is fine enough to see it.
"""

import math

import numpy as np

import rtac_jax as rtac

INERTIA, VISCOUS, COULOMB, OFFSET, TORQUE_CONSTANT = 95.0, 200.0, 20.0, -3.2, 35.0  # kg m^2, N m s, N m, N m, N m/A
CREEP = 5e-5  # speed at which dry friction has three quarters of its size [rad/s]
COUNT = 1e-6  # of the encoder [rad]
_INNER = 50


def axis(name, seconds, *, sizes, period, sample_time=1e-3):
    """Record moves out and back of these sizes [rad], one after the other, each with its rests in a period [s]."""
    step = sample_time / _INNER
    angle = speed = before = 0.0
    angles, currents = [], []
    for k in range(round(seconds / sample_time)):
        move, phase = divmod(k * sample_time / period, 1.0)
        way = min(phase / 0.4, 1.0) if phase < 0.5 else max(1.0 - (phase - 0.5) / 0.4, 0.0)
        wanted = sizes[int(move) % len(sizes)] * way**3 * (10 - 15 * way + 6 * way**2)
        seen = COUNT * round(angle / COUNT)
        current = 94.0 * (wanted - seen) - 5.8 * (seen - before) / sample_time
        before = seen
        angles.append(seen)
        currents.append(current)
        for _ in range(_INNER):
            friction = VISCOUS * speed + COULOMB * math.tanh(speed / CREEP)
            speed += step * (TORQUE_CONSTANT * current - friction - OFFSET) / INERTIA
            angle += step * speed
    return rtac.Experiment.of(
        name, kind="forced", sample_time=sample_time, cart="clamped", initial_arm_angle=0.0,
        arm_angle=np.array(angles), current=np.array(currents),
    )  # fmt: skip


def as_cart(experiment):
    """Return an experiment of the axis as one of a cart without spring beside a locked arm, and the drive as a force [N]."""
    return rtac.Experiment.of(
        experiment.name, kind="forced", sample_time=experiment.sample_time, arm="locked",
        cart_position=experiment.outputs["arm_angle"].values,
        disturbance_force=TORQUE_CONSTANT * experiment.inputs["current"].values,
    )  # fmt: skip


def recording():
    """Two experiments of the axis, whose torque constant is known."""
    experiments = [
        axis("forth and back", 6.0, sizes=(0.24, 0.14, 0.07), period=4.0),
        axis("other moves", 4.0, sizes=(0.2, 0.1, 0.26), period=3.0),
    ]
    return rtac.Recording(experiments, rig={"torque_constant": TORQUE_CONSTANT})
