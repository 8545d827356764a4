"""Regressors of the equations of motion, sample by sample: filtered and differentiated measurements."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from rtac_jax.measurement import Experiment, Signal, central_difference, filled, zero_phase_lowpass

Values = Float[np.ndarray, " sample"]
Rows = Float[np.ndarray, " row"]
ArmRows = Float[np.ndarray, " arm_row"]

_SHORT = 10  # samples from one to the next, up to which a spline bridges: few beside a period of the rig at its usual sampling


@dataclasses.dataclass(frozen=True)
class Terms:
    """The terms of both equations of motion of one experiment, one number per row and term.

    A row is a sample, or a test function over which the equation was integrated. Everything is divided by its parameter:

        mass q'' + viscous q' + dry sgn q' + spring q + swing (theta'' cos theta - theta'^2 sin theta) = force
        inertia theta'' + reaction q'' cos theta + positive and negative theta' = K_m current

    Attributes:
        name: of the experiment.
        cart: `mass`, `viscous`, `dry`, `spring`, `swing`, `force`.
        arm: `inertia`, `reaction`, `current`, `positive`, `negative`.
        angle: of the arm on the cart's rows [rad].
        sliding: rows of the cart's equation on which the sign of the velocity can be trusted.
        arm_free, has_arm: whether the arm may turn, and whether its motion was measured.
        lag: rows of the arm's equation from one to the next that integrates over none of the same samples.
        noise: standard deviation that sensor noise gives the terms `mass` and `inertia`; zero where it was not worked out.
        weight: of a constant term of the cart's equation: the integral of its test function, or one for samples.
    """

    name: str
    cart: Mapping[str, Rows]
    arm: Mapping[str, ArmRows]
    angle: Rows
    sliding: Bool[np.ndarray, " row"]
    arm_free: bool
    has_arm: bool
    lag: int = 0
    noise: tuple[float, float] = (0.0, 0.0)
    weight: float = 1.0

    @property
    def driven(self) -> bool:
        """Return whether there was a motor current."""
        return bool(np.any(self.arm["current"]))

    @property
    def pushed(self) -> bool:
        """Return whether there was a disturbance force."""
        return bool(np.any(self.cart["force"]))


def channel(experiment: Experiment, name: str) -> Values | None:
    """Return the measured values of one channel with gaps bridged, or None."""
    return bridged(experiment.outputs[name].values) if name in experiment.outputs else None


def bridged(values: Values) -> Values:
    """Return the values with short gaps bridged by a cubic spline, and longer ones by straight lines.

    Straight lines cut off the tops of an oscillation: of a position read every fifth sample the eccentric moment came out six of
    its deviations too small, by the spline none (`docs/study_log.md`). Over a long gap a spline swings out.
    """
    present = np.flatnonzero(np.isfinite(values))
    line = filled(values)
    if len(present) == len(values) or len(present) < 4:
        return line
    index = np.arange(len(values))
    after = np.clip(np.searchsorted(present, index, side="right"), 1, len(present) - 1)
    short = present[after] - present[after - 1] <= _SHORT
    within = (index > present[0]) & (index < present[-1])
    return np.where(np.isfinite(values) | ~short | ~within, line, CubicSpline(present, values[present])(index))


def require_position(experiment: Experiment) -> None:
    """Refuse an experiment in which the cart moves unseen.

    Raises:
        ValueError: it has no cart position although the cart is free.
    """
    if "cart_position" not in experiment.outputs and experiment.cart == "free":
        raise ValueError(f"experiment {experiment.name}: no cart_position, so the closed form cannot use it.")


def sampled_terms(experiment: Experiment, cutoff: float, *, near_zero: float, order: int = 9) -> Terms:
    """Filter all signals alike, differentiate, and leave out the ends, where the filter has transients.

    Args:
        experiment: free or forced.
        cutoff: of the zero-phase Chebyshev filter [Hz].
        near_zero: samples slower than this fraction of the rms velocity are not sliding.
        order: of the filter.

    Raises:
        ValueError: the experiment shows no cart position, or is too short for the filter.

    Source: paper, section 4.2.
    """
    require_position(experiment)
    dt = experiment.sample_time
    count = experiment.samples
    zero = np.zeros(count)

    def smooth(values: Values | None) -> Values:
        return zero if values is None else zero_phase_lowpass(values, sample_time=dt, cutoff=cutoff, order=order)

    position = smooth(channel(experiment, "cart_position"))
    raw_angle, raw_omega = channel(experiment, "arm_angle"), channel(experiment, "arm_velocity")
    current, force = (smooth(_around_samples(experiment.inputs.get(key))) for key in ("current", "disturbance_force"))
    inner = slice(1, -1)
    if raw_angle is not None:
        angle = smooth(raw_angle)
        omega = np.gradient(angle, dt)
        domega = second_difference(angle, dt)
    elif raw_omega is not None:
        omega = smooth(raw_omega)
        angle = integrated(omega, experiment.initial_arm_angle or 0.0, dt)
        domega = central_difference(omega, sample_time=dt)
    else:
        angle, omega, domega = zero + (experiment.initial_arm_angle or 0.0), zero, zero[inner]
    # The filter's slowest pole takes 37 / cutoff to sink to 1e-6; of a short experiment a tenth at each end must do.
    ends = int(np.ceil(max(1.5 / (cutoff * dt), min(37.0 / (cutoff * dt), 0.1 * count))))
    keep = slice(ends, count - 2 - ends)
    if count - 2 - 2 * ends < 8:
        raise ValueError(f"experiment {experiment.name}: too short for a filter at {cutoff:.3g} Hz; raise the cutoff.")
    # The equations hold for signals that are all filtered alike, and the sign jumps too fast to pass the filter whole.
    dry = smooth(np.sign(np.gradient(position, dt))) if np.any(position) else zero
    dq, ddq, domega = (
        central_difference(position, sample_time=dt)[keep],
        second_difference(position, dt)[keep],
        domega[keep],
    )
    q, angle, omega, current, force, dry = (x[inner][keep] for x in (position, angle, omega, current, force, dry))
    swing = domega * np.cos(angle) - omega**2 * np.sin(angle)
    return Terms(
        name=experiment.name,
        cart={"mass": ddq, "viscous": dq, "dry": dry, "spring": q, "swing": swing, "force": force},
        arm={
            "inertia": domega,
            "reaction": ddq * np.cos(angle),
            "current": current,
            "positive": np.where(omega > 0, omega, 0.0),
            "negative": np.where(omega < 0, omega, 0.0),
        },
        angle=angle,
        sliding=np.abs(dq) > near_zero * np.sqrt(np.mean(dq**2)),
        arm_free=experiment.arm == "free",
        has_arm=raw_angle is not None or raw_omega is not None,
    )


def integrated(omega: Values, first: float, dt: float) -> Values:
    """Integrate the angle from its rate, by the trapezoidal rule."""
    return first + np.concatenate([[0.0], np.cumsum(0.5 * dt * (omega[1:] + omega[:-1]))])


def second_difference(values: Values, dt: float) -> Float[np.ndarray, " inner"]:
    """Return the second derivative at the interior samples."""
    return (values[2:] - 2 * values[1:-1] + values[:-2]) / dt**2


def _around_samples(signal: Signal | None) -> Values | None:
    """Return the input as it acts around each sample: a held one is the mean of the values before and after."""
    if signal is None or signal.intersample != "zoh":
        return None if signal is None else signal.values
    before = np.concatenate([signal.values[:1], signal.values[:-1]])
    return 0.5 * (before + signal.values)


def automatic_cutoff(experiment: Experiment, levels: Mapping[str, float]) -> float:
    """Return the widest band [Hz] in which the noise of the accelerations stays below a thousandth of their power.

    Noise in a regressor biases its coefficient towards zero by just that fraction; a narrower filter costs little, because
    the equations hold for signals that are all filtered alike.
    """
    dt = experiment.sample_time
    widest, narrowest = 0.33 / dt, 0.02 / dt
    for name, order in (("cart_position", 2), ("arm_velocity", 1), ("arm_angle", 2)):
        values: Any = channel(experiment, name)
        if values is None or np.ptp(values) == 0:
            continue
        length = min(len(values), 1024)
        frequency, density = welch(values, fs=1 / dt, window="blackmanharris", nperseg=length, detrend="constant")
        noise = 2 * dt * levels[name] ** 2
        weight = (2 * np.pi * frequency) ** (2 * order)
        signal = np.cumsum(np.where(density > 4 * noise, density - noise, 0.0) * weight)
        good = np.nonzero(noise * np.cumsum(weight) <= 1e-3 * signal)[0]
        dominant = frequency[1:][np.argmax(density[1 : max(3, len(density) // 3)])]
        narrowest = max(narrowest, 1.5 * dominant) if name == "cart_position" else narrowest
        widest = min(widest, frequency[good[-1]] if len(good) else 0.0)
    return float(np.clip(widest, min(narrowest, 0.33 / dt), 0.33 / dt))
