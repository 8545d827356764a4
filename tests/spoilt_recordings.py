"""Recordings with one usual mistake each, made from a clean one, and the words that must name it."""

from dataclasses import replace

import numpy as np

from rtac_jax.measurement import INPUTS, OUTPUTS, Signal

FORCED, FREE, REST = "forced_2", "free_1", "rest_1"


def changed(experiment, channel, change):
    group = "inputs" if channel in INPUTS else "outputs"
    signals = dict(getattr(experiment, group))
    if channel in signals:
        old = signals[channel]
        signals[channel] = Signal(change(np.array(old.values)), old.unit, old.intersample, old.noise_std)
    return replace(experiment, **{group: signals})


def channel(name, change):
    """A change of one channel of an experiment."""
    return lambda e: changed(e, name, change)


def times(factor):
    return lambda x: factor * x


def late(x, samples=5):
    return x[np.clip(np.arange(len(x)) - samples, 0, len(x) - 1)]


def swapped(one, other):
    def change(e):
        outputs = dict(e.outputs)
        outputs[one], outputs[other] = (
            Signal(outputs[other].values, OUTPUTS[one]),
            Signal(outputs[one].values, OUTPUTS[other]),
        )
        return replace(e, outputs=outputs)

    return change


def current_as_force(e):
    if "current" not in e.inputs:
        return e
    current = e.inputs["current"]
    return replace(e, inputs={"disturbance_force": Signal(current.values, "N", current.intersample)})


def swapped_with_current(of):
    """Exchange the current and an output; an experiment without a current stays as it is."""

    def change(e):
        if "current" not in e.inputs:
            return e
        current, output = e.inputs["current"], e.outputs[of]
        inputs = {**e.inputs, "current": Signal(output.values, "A", current.intersample)}
        return replace(
            e, inputs=inputs, outputs={**e.outputs, of: Signal(current.values, output.unit, output.intersample)}
        )

    return change


def slower(factor):
    return lambda e: replace(e, sample_time=factor * e.sample_time)


def in_degrees(e):
    return replace(e, initial_arm_angle=float(np.rad2deg(e.initial_arm_angle)))


def without_samples(e, first=417, count=10):
    kept = np.r_[0:first, first + count : e.samples]

    def cut(signals):
        return {name: Signal(s.values[kept], s.unit, s.intersample) for name, s in signals.items()}

    return replace(e, inputs=cut(e.inputs), outputs=cut(e.outputs))


def dropout(held):
    def change(x):
        x[500:550] = x[499] if held else 0.0
        return x

    return change


def spikes(size):
    def change(x):
        random = np.random.default_rng(1)
        for place in random.choice(len(x) - 10, 5, replace=False) + 5:
            x[place : place + 2] += size * random.choice([-1, 1])
        return x

    return change


def swinging(e):
    time = e.time
    return changed(e, "cart_position", lambda x: x + 1e-3 * np.exp(-0.3 * time) * np.cos(10.4 * time))


def everywhere(recording, change):
    return replace(recording, experiments=tuple(change(e) for e in recording))


def in_one(recording, name, change):
    return replace(recording, experiments=tuple(change(e) if e.name == name else e for e in recording))


def with_rig(recording, **factors):
    return replace(recording, rig={name: factors.get(name, 1.0) * value for name, value in recording.rig.items()})


POSITION, VELOCITY, CURRENT = "cart_position", "arm_velocity", "current"
# By mistake: what is done to each experiment, and words of the sentence from the equations of motion.
OF_CHANNELS = {
    "position in mm": (channel(POSITION, times(1e3)), "cart_position fits when it is taken to be in mm"),
    "velocity in deg/s": (channel(VELOCITY, times(180 / np.pi)), "arm_velocity fits when it is taken to be in deg/s"),
    "velocity in rpm": (channel(VELOCITY, times(30 / np.pi)), "arm_velocity fits when it is taken to be in rpm"),
    "velocity no rpm": (channel(VELOCITY, times(np.pi / 30)), "taken to have been in rad/s, and was read as rpm"),
    "sign of position": (channel(POSITION, np.negative), "cart_position fits with the sign swapped"),
    "sign of velocity": (channel(VELOCITY, np.negative), "arm_velocity fits with the sign swapped"),
    "sign of current": (channel(CURRENT, np.negative), "current fits with the sign swapped"),
    "swapped channels": (swapped(POSITION, VELOCITY), "cart_position and arm_velocity fit when they are swapped"),
    "swapped current": (swapped_with_current(VELOCITY), "current and arm_velocity fit when they are swapped"),
    "current as force": (current_as_force, "disturbance_force fits when it is taken to be the current"),
    "sample time doubled": (slower(2.0), "half of the sample_time"),
    "sample time halved": (slower(0.5), "twice the sample_time"),
    "sample time in ms": (slower(1e3), "a thousandth of the sample_time"),
    "sample time in ks": (slower(1e-3), "a thousand times the sample_time"),
    "angle in degrees": (in_degrees, "initial_arm_angle fits when it is taken to be in degrees"),
    "offset of 5 mm": (channel(POSITION, lambda x: x + 5e-3), "5 mm"),
    "offset of 1 m": (channel(POSITION, lambda x: x + 1.0), "1e+03 mm"),
    "position late": (channel(POSITION, late), "cart_position fits when it is taken to come 5 samples late"),
    "velocity late": (channel(VELOCITY, late), "arm_velocity fits when it is taken to come 5 samples late"),
    "current late": (channel(CURRENT, late), "current fits when it is taken to come 5 samples late"),
}
OF_THE_RIG = {
    "mass in grams": ({"total_mass": 1e3}, "total_mass is 1000 times too large"),
    "inertia ten times too large": ({"arm_inertia": 10.0}, "arm_inertia is 10 times too large"),
    "inertia ten times too small": ({"arm_inertia": 0.1}, "arm_inertia is 10 times too small"),
}
# By mistake: experiment, what is done to it, and words of the sentence of `concerns`.
MOMENTARY = {
    "lost samples": (FORCED, without_samples, "samples were lost there"),
    "lost samples of a decay": (FREE, without_samples, "samples were lost there"),
    "position held": (
        FORCED,
        channel(POSITION, dropout(True)),
        "cart_position is exactly one and the same value for 51",
    ),
    "position zero": (FORCED, channel(POSITION, dropout(False)), "cart_position is exactly zero for 50 samples"),
    "velocity held": (
        FORCED,
        channel(VELOCITY, dropout(True)),
        "arm_velocity is exactly one and the same value for 51",
    ),
    "velocity zero": (FORCED, channel(VELOCITY, dropout(False)), "arm_velocity is exactly zero for 50 samples"),
    "velocity of a decay held": (
        FREE,
        channel(VELOCITY, dropout(True)),
        "arm_velocity is exactly one and the same value",
    ),
    "spikes of the position": (FORCED, channel(POSITION, spikes(5e-3)), "cart_position has 5 spikes of two or three"),
    "spikes of the velocity": (FORCED, channel(VELOCITY, spikes(20.0)), "arm_velocity has 5 spikes of two or three"),
    "rest that swings": (REST, swinging, "rest_1: cart_position swings by"),
    "free labelled rest": (FREE, lambda e: replace(e, kind="rest"), "free_1: cart_position swings by"),
}
