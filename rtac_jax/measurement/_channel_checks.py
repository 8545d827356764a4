"""Checks between the channels of an experiment, and between experiments, that need no model: kinematics, sampling, rest."""

from collections.abc import Iterator

import numpy as np
import scipy.stats
from jaxtyping import Float64

from ._experiment import Experiment
from ._filter import filled
from ._recording import Recording

Values = Float64[np.ndarray, " sample"]

_GRAVITY = 9.81
# Ten g, sixty times what the paper's rig reaches: springs and motors that move a cart so are no laboratory rig's.
_LARGEST_ACCELERATION = 10 * _GRAVITY
# Three times the standard deviation with which an arm is set by hand [rad].
_ANGLE_REACH = 0.3
# A mean beyond five times half the range of the largest motion: a cart that oscillates about it would have left every other one.
_OFF_CENTRE = 5.0
_ABOVE_NOISE = 3.0  # times the noise from which on a channel shows a motion
# A gain between velocity and angle is no sensor's gain error beyond this factor.
_GAIN = 1.3
_FEWEST_LAG = 3  # samples; fewer are a sensor's lag, which is an effect of the catalogue
_MOST_LAG = 16
_HUNDRED = 100.0  # ratio of two experiments beyond which ranges do not explain noise and motion
# Of the power at the cart's frequency to that beside it; chance gives at most ln(bins / 1e-6), some 20, if the noise is white, and
# three times that beside the corner of coloured noise.
_LINE = 100.0
_HUM = 0.01  # of the frequency of the mains, within which a swing is likely theirs
_FACTORS = {
    180 / np.pi: "arm_angle is in degrees",
    np.pi / 180: "arm_velocity is in deg/s",
    np.pi / 30: "arm_velocity is in rpm",
    1 / (2 * np.pi): "arm_angle is in revolutions",
    2 * np.pi: "arm_velocity is in revolutions per second",
    0.5: "sample_time is twice the true one",
    2.0: "sample_time is half of the true one",
    1e-3: "sample_time is in ms",
    1e3: "sample_time is a thousandth of the true one",
}


def channel_concerns(experiment: Experiment) -> Iterator[str]:
    """Yield what contradicts itself within one moving experiment."""
    velocity, angle = (experiment.outputs.get(name) for name in ("arm_velocity", "arm_angle"))
    free_arm = experiment.arm == "free"
    if free_arm and velocity is not None and angle is not None:
        yield from _angle_against_velocity(angle.values, velocity.values, experiment.sample_time)
    yield from _initial_angle(experiment)
    if experiment.cart == "free" and turns_fast(experiment):
        yield (
            "the arm turns by more than half a turn from one sample to the next, so sample_time is likely in ms, or "
            "arm_velocity in deg/s; give both in SI units."
        )
    if "cart_position" in experiment.outputs and experiment.cart == "free":
        yield from _position(experiment)


def turns_fast(experiment: Experiment) -> bool:
    """Return whether a free arm turns by more than half a turn from one sample to the next, by its measured speed."""
    velocity = experiment.outputs.get("arm_velocity")
    if velocity is None or experiment.arm != "free":
        return False
    return float(np.nanmax(np.abs(velocity.values))) * experiment.sample_time > np.pi


def jumps(experiment: Experiment) -> float:
    """Return the fraction of samples from which a free arm's angle alone has turned by more than half a turn at the next."""
    angle = experiment.outputs.get("arm_angle")
    if angle is None or "arm_velocity" in experiment.outputs or experiment.arm != "free" or len(angle.values) < 2:
        return 0.0
    steps = np.diff(angle.values)
    steps = steps[np.isfinite(steps)]
    return float(np.mean(np.abs(steps) > np.pi)) if len(steps) else 0.0


def unit_concerns(recording: Recording) -> Iterator[str]:
    """Yield experiments whose cart_position has an offset, or another unit than that of the others, as noise and motion show."""
    holders = [e for e in recording if e.kind != "rest" and e.cart == "free" and "cart_position" in e.outputs]
    slide = recording.rig.get("spring_stiffness") == 0.0
    reach = max((0.5 * float(np.ptp(_bridged(e))) for e in holders), default=0.0)
    for e in holders:
        mean = float(np.mean(_bridged(e)))
        if abs(mean) > _OFF_CENTRE * reach > 0 and not slide:
            yield (
                f"{e.name}: cart_position moves around {mean:.3g} m, {abs(mean) / reach:.2g} times as far from 0 as it moves, so "
                "it has an offset; subtract it, or give a slide without a spring the constant spring_stiffness=0."
            )
    if len(holders) < 3:
        return
    motion, noise = (np.array([f(_bridged(e)) for e in holders]) for f in (np.std, _quiet))
    for place, e in enumerate(holders):
        others = np.arange(len(holders)) != place
        ratios = [float(x[place] / max(np.median(x[others]), 1e-300)) for x in (motion, noise)]
        if min(ratios) > _HUNDRED:
            yield (
                f"{e.name}: cart_position and its noise are both some {min(ratios):.2g} times larger than in the others, "
                "so it is likely in mm; multiply it by 0.001."
            )


def rest_concerns(recording: Recording) -> Iterator[str]:
    """Yield the experiments of kind rest in which something moves, beside hum that can be subtracted."""
    for name, (channel, frequency, size, unit) in _moving(recording.without_hum()).items():
        mend = "set its kind to free, or record it again with nothing moving"
        if any(abs(frequency - mains) < _HUM * mains for mains in (50.0, 60.0, 100.0, 120.0)):
            mend = (
                "that is likely hum of the mains: shield the sensor, or filter it out of all experiments alike "
                "(scipy.signal.iirnotch)"
            )
        yield (
            f"{name}: {channel} swings by {size:.2g} {unit} at {frequency:.3g} Hz although the experiment is of kind rest, so it "
            f"does not tell the noise; {mend}."
        )


def moving_at_rest(recording: Recording) -> list[str]:
    """Return the names of the experiments of kind rest in which something moves as it does in the others."""
    return list(_moving(recording))


def _moving(recording: Recording) -> dict[str, tuple[str, float, float, str]]:
    """Return channel, frequency [Hz], amplitude and unit of what moves at rest, by experiment."""
    found: dict[str, tuple[str, float, float, str]] = {}
    moving = [e for e in recording if e.kind != "rest"]
    for e in recording:
        if e.kind != "rest" or e.name in found:
            continue
        for channel, signal in e.outputs.items():
            others = [o for o in moving if channel in o.outputs]
            values = filled(signal.values)
            if not others or np.ptp(values) == 0:
                continue
            rhythm = [_peak(filled(o.outputs[channel].values), o.sample_time)[0] for o in others]
            usual = float(np.median([np.std(filled(o.outputs[channel].values)) for o in others]))
            frequency, ratio = _peak(values, e.sample_time)
            swings = ratio > _LINE and min(rhythm) / 2 < frequency < 2 * max(rhythm)
            large = np.std(values) > 0.1 * usual and np.std(values) > 10 * _quiet(values)
            if swings or large:
                found[e.name] = (channel, frequency, float(np.sqrt(2) * np.std(values)), signal.unit)
                break
    return found


def _peak(values: Values, sample_time: float) -> tuple[float, float]:
    """Return the frequency [Hz] of the largest peak of at least two periods, and how far it stands above what is beside it."""
    time = np.arange(len(values))
    values = values / max(float(np.max(np.abs(values))), 1e-300)
    straight = values - np.polyval(np.polyfit(time, values, 1), time)
    power = np.abs(np.fft.rfft(straight * np.hanning(len(values)))) ** 2
    first = 2
    peak = first + int(np.argmax(power[first:]))
    beside = np.arange(max(1, peak // 4), min(4 * peak + 8, len(power)))
    beside = beside[np.abs(beside - peak) > 3]
    floor = float(np.mean(power[beside])) if len(beside) else np.inf
    return peak / (len(values) * sample_time), float(power[peak]) / max(floor, 1e-300)


def _angle_against_velocity(angle: Values, velocity: Values, sample_time: float) -> Iterator[str]:
    """Hold the angle's increments against those of the integral of the velocity."""
    good = ~(np.isnan(angle) | np.isnan(velocity))
    if good.sum() < 4 * _MOST_LAG:
        return
    angle, velocity = filled(angle), filled(velocity)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * sample_time * (velocity[1:] + velocity[:-1]))])
    width = max(4, len(angle) // 50)

    def together(lag: int) -> tuple[float, float]:
        """Return slope and correlation with the angle this many samples later."""
        a = angle[max(lag, 0) : len(angle) + min(lag, 0)]
        i = integral[max(-lag, 0) : len(integral) + min(-lag, 0)]
        da, di = a[width:] - a[:-width], i[width:] - i[:-width]
        da, di = da - da.mean(), di - di.mean()
        size = float(np.sqrt(np.sum(da**2) * np.sum(di**2)))
        return float(np.sum(da * di) / max(np.sum(di**2), 1e-300)), float(np.sum(da * di)) / size if size > 0 else 0.0

    by_lag = {lag: together(lag) for lag in range(-_MOST_LAG, _MOST_LAG + 1)}
    best = max(by_lag, key=lambda lag: abs(by_lag[lag][1]))
    slope, correlation = by_lag[best]
    if correlation**2 < 0.9:
        # Where hardly anything moves, noise alone is not alike either.
        independent = len(angle) / width
        if abs(correlation) < scipy.stats.norm.ppf(1 - 1e-6) / np.sqrt(independent) and np.std(integral) > 1.0:
            yield "arm_angle does not follow the integral of arm_velocity at all; check that the columns are the right ones."
        return
    if abs(best) >= _FEWEST_LAG and 1 - correlation**2 < 0.1 * (1 - by_lag[0][1] ** 2):
        late, early = ("arm_angle", "arm_velocity") if best > 0 else ("arm_velocity", "arm_angle")
        yield f"{late} comes {abs(best)} samples after {early}; shift it by {-abs(best)} samples, or synchronise the loggers."
    if slope < 0:
        yield "arm_angle turns against arm_velocity; swap the sign of the one that counts the other way than the current drives."
    if abs(np.log(abs(slope))) > np.log(_GAIN):
        factor = min(_FACTORS, key=lambda f: abs(np.log(abs(slope) / f)))
        if abs(np.log(abs(slope) / factor)) < np.log(1.1):
            yield f"arm_angle agrees with the integral of arm_velocity only if {_FACTORS[factor]}; give SI units."
        else:
            yield (
                f"arm_angle grows by {abs(slope):.2g} times the integral of arm_velocity; check both units and sample_time."
            )


def _initial_angle(experiment: Experiment) -> Iterator[str]:
    start = experiment.initial_arm_angle
    if start is None:
        return
    if "arm_angle" in experiment.outputs:
        begins = experiment.outputs["arm_angle"].values[:3]
        begins = begins[~np.isnan(begins)]
        first = float(np.mean(begins)) if len(begins) else start
        if abs(first - start) < _ANGLE_REACH:
            return
        if abs(start) > np.pi and abs(first - np.deg2rad(start)) < _ANGLE_REACH:
            yield "initial_arm_angle agrees with the first arm_angle only if it is in degrees; multiply it by 0.01745."
        elif abs(np.deg2rad(first) - start) < _ANGLE_REACH:
            yield "arm_angle begins at initial_arm_angle only if it is in degrees; multiply arm_angle by 0.01745."
        elif abs(first + start) < _ANGLE_REACH:
            yield "arm_angle begins at minus initial_arm_angle, as of a sensor that counts the other way; multiply one by -1."
        else:
            yield f"initial_arm_angle is {start:.3g} rad, but arm_angle begins at {first:.3g} rad; correct one of the two."
    elif abs(start) > 2 * np.pi:
        yield "initial_arm_angle is more than a whole turn, so it is likely in degrees; multiply it by 0.01745."


def _position(experiment: Experiment) -> Iterator[str]:
    values = _bridged(experiment)
    size = float(np.std(values))
    # Noise alone has no frequency that says anything of accelerations.
    if size <= _ABOVE_NOISE * _quiet(values):
        return
    frequency, _ = _peak(values, experiment.sample_time)
    time = np.arange(len(values))
    swing = float(np.std(values - np.polyval(np.polyfit(time, values, 1), time)))  # a slide that travels on is no swing
    with np.errstate(over="ignore"):  # of a sample time of 1e-300 s
        acceleration = np.square(2 * np.pi * np.float64(frequency)) * np.sqrt(2) * swing
    if acceleration > _LARGEST_ACCELERATION:
        yield (
            "cart_position shows accelerations of more than 10 g, so it is likely in mm, or sample_time is too small; give both in "
            "SI units."
        )


def _quiet(values: Values) -> float:
    """Return the standard deviation of the noise, from second differences of which half are smaller."""
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6))


def _bridged(experiment: Experiment) -> Values:
    return filled(experiment.outputs["cart_position"].values)
