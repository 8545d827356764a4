"""The beginning of a fit: initial states of each experiment, scales of a rig, and the space of unknowns."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.parameter_space import Space
from estimators.core.residual import start_rows
from rtac_jax import RTAC, Scales
from rtac_jax.measurement import Experiment, Signal, filled

ANGLE_SPREAD = 0.1  # rad; an arm set by hand at its initial_arm_angle
UNKNOWN_ANGLE = 3.0  # rad
_FOLLOWED = 1.5  # rms error of a parabola over the noise up to which it follows the signal
_SHORTER = 0.75  # number of samples over the one before, where it does not
UNKNOWN_SPEED = 10.0  # rad/s; an arm without tachometer or encoder


def dominant_frequency(experiments: Sequence[Experiment]) -> float:
    """Return the frequency at which the cart's position, or else the arm, moves most [Hz], the median over experiments."""
    found = []
    for experiment in experiments:
        for channel in ("cart_position", "arm_velocity", "arm_angle"):
            if channel in experiment.outputs:
                values = filled(experiment.outputs[channel].values)
                if np.ptp(values) > 0:
                    found.append(_highest_line(values) / (len(values) * experiment.sample_time))
                    break
    return float(np.median(found)) if found else 1.0


def _highest_line(values: Float[np.ndarray, " sample"]) -> int:
    """Return the place of the largest line of the spectrum, a straight line taken out and a Hann window put on."""
    count = len(values)
    ramp = np.arange(count) - 0.5 * (count - 1)
    level = values - np.mean(values)
    level = level - ramp * (ramp @ level) / max(ramp @ ramp, 1.0)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)
    return 1 + int(np.argmax(np.abs(np.fft.rfft(window * level))[1:]))


def first_values(signal: Signal, sample_time: float, frequency: float, degree: int = 2) -> tuple[float, float]:
    """Return value and slope at the first sample, by a parabola through the first samples.

    They span a tenth of a period, or as long as the parabola stays within the noise: an arm that is turned slowly to and fro may
    move fast beside that.
    """
    values = filled(signal.values)
    least = min(degree + 3, len(values))
    count = int(np.clip(0.15 / (frequency * sample_time), least, len(values)))
    noise = _roughness(values)
    while True:
        time = sample_time * np.arange(count)
        fit = np.polynomial.Polynomial.fit(time, values[:count], degree)
        left = np.sum((values[:count] - fit(time)) ** 2) / max(count - degree - 1, 1)
        if count <= least or left <= (_FOLLOWED * noise) ** 2:
            return float(fit(0.0)), float(fit.deriv()(0.0))
        count = max(least, int(_SHORTER * count))


def _roughness(values: Float[np.ndarray, " sample"]) -> float:
    """Return the standard deviation of white noise whose third differences are as large; infinite where there are none."""
    return float(np.sqrt(np.mean(np.diff(values, 3) ** 2) / 20)) if len(values) > 3 else np.inf


def initial_states(
    experiments: Sequence[Experiment],
) -> tuple[Float[np.ndarray, "4 experiment"], Float[np.ndarray, "4 experiment"], Float[np.ndarray, "4 experiment"]]:
    """Return the initial states [m, m/s, rad, rad/s] as the first samples show them, their spread, and which are held.

    Each is [4, experiment].
    """
    frequency = dominant_frequency(experiments)
    state = np.zeros((4, len(experiments)))
    spread = np.full((4, len(experiments)), np.inf)
    held = np.zeros((4, len(experiments)))
    for column, experiment in enumerate(experiments):
        outputs, dt = experiment.outputs, experiment.sample_time
        known = experiment.initial_arm_angle
        if "cart_position" in outputs:
            state[:2, column] = first_values(outputs["cart_position"], dt, frequency)
        else:
            spread[:2, column] = 0.02, 0.2
        if "arm_angle" in outputs:
            state[2:, column] = first_values(outputs["arm_angle"], dt, frequency)
        else:
            state[2, column] = known if known is not None else 0.0
            spread[2, column] = angle_spread(experiment)
        if "arm_velocity" in outputs:
            state[3, column] = first_values(outputs["arm_velocity"], dt, frequency)[0]
        elif "arm_angle" not in outputs:
            spread[3, column] = UNKNOWN_SPEED
        if experiment.cart == "clamped":
            state[:2, column], held[:2, column] = 0.0, 1.0
        if experiment.arm == "locked":
            state[3, column], held[2:, column] = 0.0, 1.0
    return state, spread, held


def angle_spread(experiment: Experiment) -> float:
    """Return the standard deviation of what is known beforehand of the arm's angle at the start [rad]."""
    if experiment.initial_arm_angle is None:
        return UNKNOWN_ANGLE
    return experiment.initial_arm_angle_std or ANGLE_SPREAD


def scales_of(model: RTAC, experiments: Sequence[Experiment]) -> Scales:
    """Return typical sizes, for what is plausible and for scaling."""
    moving = [e for e in experiments if e.kind != "rest"]
    frequency = 2 * np.pi * dominant_frequency(moving)

    def rms(group: str, channel: str, floor: float) -> float:
        found = [getattr(e, group)[channel].values for e in moving if channel in getattr(e, group)]
        squares = [np.nanmean((x - np.nanmean(x) if group == "outputs" else x) ** 2) for x in found]
        return max(float(np.sqrt(np.mean(squares))), floor) if squares else floor

    position = rms("outputs", "cart_position", 1e-9)
    arm_velocity = rms("outputs", "arm_velocity", 0.0)
    if arm_velocity == 0.0:
        rates = [
            np.gradient(filled(e.outputs["arm_angle"].values), e.sample_time)
            for e in moving
            if "arm_angle" in e.outputs
        ]
        arm_velocity = max(float(np.sqrt(np.mean([np.mean(r**2) for r in rates]))) if rates else 0.0, 1e-9)
    current = rms("inputs", "current", 1e-9)
    body = model.body
    return Scales(
        position=position,
        velocity=position * frequency,
        arm_velocity=arm_velocity,
        current=current,
        force=float(body.spring_stiffness) * position,
        torque=max(float(body.torque_constant) * current, float(body.arm_inertia) * arm_velocity * frequency),
        frequency=frequency,
        mass=float(body.total_mass),
        sample_time=min(e.sample_time for e in moving),
    )


def space_of(
    model: RTAC,
    experiments: Sequence[Experiment],
    *,
    free: Sequence[str],
    start: Mapping[str, np.ndarray] | None = None,
) -> Space:
    """Return the unknowns of a fit: these free parameters, and the states at the start of each experiment.

    Args:
        model: gives values, bounds and scales.
        experiments: whose initial states are unknown.
        free: names of the shared parameters to estimate; parameters of each experiment are always estimated.
        start: states at the start by experiment, to begin from instead of what the first samples show.
    """
    scales = scales_of(model, experiments)
    declared = model.parameters
    each = tuple(name for name in declared if name in model.per_experiment)
    names = tuple(name for name in declared if name not in each)
    count = len(experiments)
    state, spread, held = initial_states(experiments)
    rows = start_rows(model)
    extra = len(rows) - 4
    by_unit = {
        "m": scales.position, "m/s": scales.velocity, "rad": 1.0, "rad/s": scales.arm_velocity, "A": scales.current,
        "N": scales.force, "N m": scales.torque,
    }  # fmt: skip
    size = np.array([by_unit.get(model.states[row], 1.0) for row in rows])
    state = np.concatenate([state, np.zeros((extra, count))])
    # A recording seldom begins far from equilibrium in a state that nothing shows, and where an effect is nearly
    # absent nothing else holds that state in place.
    spread = np.concatenate([spread, np.broadcast_to(size[4:, None], (extra, count))])
    held = np.concatenate([held, np.zeros((extra, count))])
    if start is not None:
        for column, experiment in enumerate(experiments):
            if experiment.name in start:
                found = np.asarray(start[experiment.name])
                state[: len(found), column] = found

    scale = np.array(np.broadcast_to(0.1 * size[:, None], state.shape))
    for column, experiment in enumerate(experiments):
        if experiment.initial_arm_angle_std is not None and "arm_angle" not in experiment.outputs:
            scale[2, column] = experiment.initial_arm_angle_std

    def bounds(which: Sequence[str], side: int) -> jnp.ndarray:
        return jnp.asarray([declared[name].bounds[side] for name in which])

    def sizes(which: Sequence[str]) -> jnp.ndarray:
        return jnp.asarray([_size(model, name, scales) for name in which])

    return Space(
        values=jnp.asarray([float(np.asarray(model[name])) for name in names]),
        active=jnp.asarray([names.index(name) for name in free if name in names], dtype=int),
        lower=bounds(names, 0),
        upper=bounds(names, 1),
        scale=sizes(names),
        each_values=jnp.stack([jnp.broadcast_to(model[name], (count,)) for name in each])
        if each
        else jnp.asarray(np.zeros((0, count))),
        each_lower=bounds(each, 0),
        each_upper=bounds(each, 1),
        each_scale=sizes(each),
        start=jnp.asarray(state),
        start_scale=jnp.asarray(scale),
        start_spread=jnp.asarray(spread),
        start_held=jnp.asarray(held),
        names=names,
        each=each,
        **_priors(model, names),
    )


def _priors(model: RTAC, names: Sequence[str]) -> dict[str, jnp.ndarray]:
    """Return what was measured beforehand of these parameters and its standard deviation, as `Space` takes them."""
    uncertain = [name for name in model.uncertain if name in names]
    if not uncertain:
        return {}
    known = np.array([float(np.asarray(model[name])) for name in names])
    std = np.full(len(names), np.inf)
    for name in uncertain:
        known[names.index(name)] = float(model.priors[name].mean)
        std[names.index(name)] = float(model.priors[name].std)
    return {"known": jnp.asarray(known), "known_std": jnp.asarray(std)}


def _size(model: RTAC, name: str, scales: Scales) -> float:
    """Return the order of magnitude of a parameter: a plausible value, or the present one where that is larger."""
    declared = model.parameters[name]
    guess = declared.plausible(scales) if declared.plausible else 0.0
    plausible = max(abs(x) for x in guess) if isinstance(guess, tuple) else abs(guess)
    present = float(np.max(np.abs(np.asarray(model[name]))))
    return max(plausible if np.isfinite(plausible) else 0.0, present) or 1.0
