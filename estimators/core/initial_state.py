"""The beginning of a fit: initial states of each experiment, scales of a rig, and the space of unknowns."""

import functools
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float

from estimators.core.parameter_space import Space
from estimators.core.residual import start_rows
from rtac_jax import RTAC, Declaration, Scales
from rtac_jax.measurement import Experiment, Signal, filled
from rtac_jax.programs.arrays import to_jax

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
    ramp, window = _ramp_and_window(len(values))
    level = values - np.mean(values)
    level = level - ramp * (ramp @ level) / max(ramp @ ramp, 1.0)
    return 1 + int(np.argmax(np.abs(np.fft.rfft(window * level))[1:]))


@functools.lru_cache(maxsize=64)
def _ramp_and_window(count: int) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    place = np.arange(count)
    return place - 0.5 * (count - 1), 0.5 - 0.5 * np.cos(2 * np.pi * place / count)


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
        powers, inverse = _polynomial(count, degree)
        fit = inverse @ values[:count]
        error = values[:count] - powers @ fit
        left = error @ error / max(count - degree - 1, 1)
        if count <= least or left <= (_FOLLOWED * noise) ** 2:
            slope = np.arange(1, degree + 1) * powers[0, :-1] @ fit[1:]
            return float(powers[0] @ fit), float(slope * 2.0 / (max(count - 1, 1) * sample_time))
        count = max(least, int(_SHORTER * count))


@functools.lru_cache(maxsize=1024)
def _polynomial(count: int, degree: int) -> tuple[Float[np.ndarray, "sample power"], Float[np.ndarray, "power sample"]]:
    """Return rising powers of the time, which runs from -1 to 1, and their pseudo-inverse."""
    powers = np.vander(np.linspace(-1.0, 1.0, count), degree + 1, increasing=True)
    return powers, np.linalg.pinv(powers)


def _roughness(values: Float[np.ndarray, " sample"]) -> float:
    """Return the standard deviation of white noise whose third differences are as large; infinite where there are none."""
    if len(values) <= 3:
        return np.inf
    # Written out, and below likewise: every start of every repetition of a study asks for it.
    change = values[3:] - 3.0 * values[2:-1] + 3.0 * values[1:-2] - values[:-3]
    return float(np.sqrt(change @ change / (20 * len(change))))


def initial_states(
    experiments: Sequence[Experiment], frequency: float | None = None
) -> tuple[Float[np.ndarray, "4 experiment"], Float[np.ndarray, "4 experiment"], Float[np.ndarray, "4 experiment"]]:
    """Return the initial states [m, m/s, rad, rad/s] as the first samples show them, their spread, and which are held.

    Each is [4, experiment]. Where the frequency of the motion [Hz] is known it need not be looked for.
    """
    frequency = frequency or dominant_frequency(experiments)
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


def without_angle(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments of whose arm's angle nothing is known: neither noted at the start nor measured."""
    return [e for e in experiments if e.initial_arm_angle is None and "arm_angle" not in e.outputs]


def _unseen(experiment: Experiment) -> list[int]:
    """Return which of the four states the first sample does not show although a sensor measures them later."""
    late = {channel for channel, signal in experiment.outputs.items() if not np.isfinite(signal.values[0])}
    states = [0, 1] if "cart_position" in late else []
    if "arm_angle" in late:
        states.append(2)
    if late & {"arm_angle", "arm_velocity"} and not {"arm_angle", "arm_velocity"} & (set(experiment.outputs) - late):
        states.append(3)
    return states


def angle_spread(experiment: Experiment) -> float:
    """Return the standard deviation of what is known beforehand of the arm's angle at the start [rad]."""
    if experiment.initial_arm_angle is None:
        return UNKNOWN_ANGLE
    return experiment.initial_arm_angle_std or ANGLE_SPREAD


def _mean_square(values: Float[np.ndarray, " sample"], *, about_mean: bool) -> float:
    present = np.isfinite(values)
    values = values if present.all() else values[present]
    values = values - np.mean(values) if about_mean else values
    return float(values @ values) / len(values)


_SCALED = ("spring_stiffness", "torque_constant", "arm_inertia", "total_mass")


def scales_of(model: RTAC, experiments: Sequence[Experiment]) -> Scales:
    """Return typical sizes, for what is plausible and for scaling."""
    moving = [e for e in experiments if e.kind != "rest"]
    frequency = 2 * np.pi * dominant_frequency(moving)

    def rms(group: str, channel: str, floor: float) -> float:
        found = [getattr(e, group)[channel].values for e in moving if channel in getattr(e, group)]
        squares = [_mean_square(x, about_mean=group == "outputs") for x in found]
        return max(float(np.sqrt(np.mean(squares))), floor) if squares else floor

    position = rms("outputs", "cart_position", 1e-9)
    arm_velocity = rms("outputs", "arm_velocity", 0.0)
    if arm_velocity == 0.0:
        rates = [
            np.gradient(filled(e.outputs["arm_angle"].values), e.sample_time)
            for e in moving
            if "arm_angle" in e.outputs
        ]
        # Of an arm that nothing shows: one that swings by a radian as fast as the cart.
        plausible = frequency if any(e.arm == "free" for e in moving) else 0.0
        arm_velocity = max(float(np.sqrt(np.mean([np.mean(r**2) for r in rates]))) if rates else plausible, 1e-9)
    current = rms("inputs", "current", 1e-9)
    applied = rms("inputs", "disturbance_force", 1e-9)
    # Of a parameter that each experiment has for itself the mean.
    body = {name: float(np.mean(np.asarray(model[name]))) for name in _SCALED}
    return Scales(
        position=position,
        velocity=position * frequency,
        arm_velocity=arm_velocity,
        current=current,
        force=max(body["spring_stiffness"] * position, applied),
        torque=max(body["torque_constant"] * current, body["arm_inertia"] * arm_velocity * frequency),
        frequency=frequency,
        mass=body["total_mass"],
        sample_time=min(e.sample_time for e in moving),
        applied_force=applied,
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
    return jax.tree.map(to_jax, space_in_numpy(model, experiments, free=free, start=start))


def space_in_numpy(
    model: RTAC,
    experiments: Sequence[Experiment],
    *,
    free: Sequence[str],
    start: Mapping[str, np.ndarray] | None = None,
) -> Space:
    """Return what `space_of` does, in arrays of NumPy, for what is put side by side before it is computed with."""
    scales = scales_of(model, experiments)
    declared, values = model.parameters, {name: np.asarray(value) for name, value in model.values.items()}
    each = tuple(name for name in declared if name in model.per_experiment)
    names = tuple(name for name in declared if name not in each)
    count = len(experiments)
    moving = [e for e in experiments if e.kind != "rest"]
    known = scales.frequency / (2 * np.pi) if len(moving) == len(experiments) else None
    state, spread, held = initial_states(experiments, known)
    rows = start_rows(model)
    extra = len(rows) - 4
    by_unit = {
        "m": scales.position, "m/s": scales.velocity, "rad": 1.0, "rad/s": scales.arm_velocity, "A": scales.current,
        "N": scales.force, "N m": scales.torque,
    }  # fmt: skip
    units = model.states
    size = np.array([by_unit.get(units[row], 1.0) for row in rows])
    # A bristle is bent no farther than where it yields, however far the cart moves.
    reach = {
        f"{effect.id}.{state}": float(np.max(np.asarray(most)))
        for effect in model.effects
        for state, most in zip(effect.states, effect.reach(), strict=False)
    }
    size = np.array([min(s, max(reach.get(row, np.inf), 1e-9 * s)) for row, s in zip(rows, size, strict=True)])
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
        # The first samples that there are may be far from where the experiment begins.
        unseen = _unseen(experiment)
        scale[unseen, column] = 2.0 * size[unseen]

    def bounds(which: Sequence[str], side: int) -> np.ndarray:
        return np.array([declared[name].bounds[side] for name in which], dtype=float)

    def sizes(which: Sequence[str]) -> np.ndarray:
        return np.array([_size(declared[name], values[name], scales) for name in which], dtype=float)

    return Space(
        values=np.array([float(values[name]) for name in names]),
        active=np.array([names.index(name) for name in free if name in names], dtype=int),
        lower=bounds(names, 0),
        upper=bounds(names, 1),
        scale=sizes(names),
        each_values=np.stack([np.broadcast_to(values[name], (count,)) for name in each])
        if each
        else np.zeros((0, count)),
        each_lower=bounds(each, 0),
        each_upper=bounds(each, 1),
        each_scale=sizes(each),
        start=state,
        start_scale=scale,
        start_spread=spread,
        start_held=held,
        names=names,
        each=each,
        **_priors(model, names),
    )


def _priors(model: RTAC, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return what was measured beforehand of these parameters and its standard deviation, as `Space` takes them."""
    uncertain = [name for name in model.uncertain if name in names]
    if not uncertain:
        return {}
    known = np.array([float(np.asarray(model[name])) for name in names])
    std = np.full(len(names), np.inf)
    for name in uncertain:
        known[names.index(name)] = float(model.priors[name].mean)
        std[names.index(name)] = float(model.priors[name].std)
    return {"known": known, "known_std": std}


def _size(declared: Declaration, value: np.ndarray, scales: Scales) -> float:
    """Return the order of magnitude of a parameter: a plausible value, or the present one where that is larger."""
    guess = declared.plausible(scales) if declared.plausible else 0.0
    plausible = max(abs(x) for x in guess) if isinstance(guess, tuple) else abs(guess)
    present = abs(float(value)) if value.ndim == 0 else float(np.max(np.abs(value)))
    return max(plausible if np.isfinite(plausible) else 0.0, present) or 1.0
