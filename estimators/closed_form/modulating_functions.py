"""The equations of motion integrated against smooth test functions, so that no measurement is differentiated twice."""

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Float
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline

from estimators.closed_form.regressors import Terms, channel, integrated, require_position
from estimators.core.initial_state import dominant_frequency
from rtac_jax.measurement import Experiment, Signal

Values = Float[np.ndarray, " sample"]

NEAR_WEAK = 0.2
"""Of the cart's fastest stretch: a test function over which the cart is slower is left out of the weak form."""

_POWER = 6  # of the test function (1 - s^2)^p: smooth enough that sums over samples are integrals
_CART = 0.5  # half width of a test function of the cart's equation, in periods of its oscillation
_ARM = 0.30  # and of the arm's, whose motion is faster
_STEPS = 4  # test functions per half width
_BAND = 4.0  # up to this many times the cart's frequency its velocity is looked at for turns
_QUICK = 2.0  # times that band for the velocity by which the cart turns the arm
_KINKS = 2  # times the turns are looked for again with the kink of dry friction put back
_NARROWEST = 8  # samples of half a test function, at least, where the noise says how narrow it may be
_NOISY = 1e-3  # of the power of the arm's acceleration that may be noise: it biases a regressor by just as much
_TRUSTED = 5.0  # standard deviations of the noise above which a velocity has a sign


class ModulatingFunctions:
    """Test functions of one half width over one experiment, and integrals against them and their derivatives."""

    def __init__(self, samples: int, dt: float, half: float) -> None:
        self.dt = dt
        self.m = max(4, round(half / dt))
        if samples < 2 * self.m + 2:
            raise ValueError("too short")
        self.step = max(1, self.m // _STEPS)
        self.lag = -(-2 * self.m // self.step)
        bump = Polynomial([1.0, 0.0, -1.0]) ** _POWER
        s = np.arange(-self.m, self.m + 1) / self.m
        size = self.m * dt
        self.weights = [bump(s) * dt, bump.deriv(1)(s) * dt / size, bump.deriv(2)(s) * dt / size**2]
        primitive = bump.integ()
        self.held = np.diff(primitive(s)) * size
        self.middle = np.arange(self.m, samples - self.m, self.step)

    def __call__(self, values: Values, order: int = 0) -> Float[np.ndarray, " row"]:
        """Return the integral of the test functions times the derivative of this order, by parts."""
        return (-1.0) ** order * self._windows(values, 2 * self.m + 1) @ self.weights[order]

    def of_input(self, signal: Signal | None) -> Float[np.ndarray, " row"]:
        """Return the integral of an input as it acts between samples: exact for one that is held."""
        if signal is None:
            return np.zeros(len(self.middle))
        if signal.intersample == "zoh":
            return self._windows(signal.values, 2 * self.m) @ self.held
        return self(signal.values)

    def of_kinks(self, jumps: Values, order: int) -> Float[np.ndarray, " row"]:
        """Return the trapezoidal rule's error where the slope of a signal jumps at samples: dt^2 / 12 times the jump."""
        return self._windows(jumps, 2 * self.m + 1) @ self.weights[order] * self.dt / 12

    def noise(self, level: float, order: int) -> float:
        """Return the standard deviation that white noise of this level gives the integral."""
        return float(level * np.sqrt(np.sum(self.weights[order] ** 2)))

    def largest(self, values: Values) -> Float[np.ndarray, " row"]:
        """Return the root mean square of a signal over each test function's support."""
        return np.sqrt(np.mean(self._windows(values, 2 * self.m + 1) ** 2, axis=1))

    def _windows(self, values: Values, length: int) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(values, length)[:: self.step][: len(self.middle)]


class WeakMotion(NamedTuple):
    """The motion of one experiment beside the test functions of both equations; arrays have one element per sample.

    Attributes:
        on_cart, on_arm: the test functions.
        position: of the cart, as measured, gaps bridged [m]; zero where it is clamped.
        velocity: of the cart, smooth, by which its turns are found [m/s].
        quick: the same in a wider band.
        angle: of the arm, as measured or integrated from its velocity [rad].
        omega: the arm's velocity, as measured or differentiated from a smooth angle [rad/s].
        turning: the same, smooth.
        band: of the smooth velocity of the cart [Hz].
        from_angle: the arm's velocity is not measured, its angle is.
        has_arm: the arm's motion is measured.
    """

    on_cart: ModulatingFunctions
    on_arm: ModulatingFunctions
    position: Values
    velocity: Values
    quick: Values
    angle: Values
    omega: Values
    turning: Values
    band: float
    from_angle: bool
    has_arm: bool


def weak_motion(experiment: Experiment, levels: Mapping[str, float] | None = None) -> WeakMotion:
    """Return the motion of an experiment, and test functions as wide as its rhythm asks.

    Args:
        experiment: that moves.
        levels: noise of each channel, SI units: the arm's test functions are as narrow as that allows, as nobody knows how fast
            the arm moves. None for the rhythm of the cart.

    Raises:
        ValueError: the experiment shows no cart position, or is shorter than two test functions.
    """
    require_position(experiment)
    dt, count = experiment.sample_time, experiment.samples
    frequency = dominant_frequency([experiment])
    if experiment.cart == "clamped":
        # The arm has no rhythm of its own, and a slow drift must not ask for test functions longer than the experiment.
        frequency = max(frequency, 4.0 / experiment.duration)
    try:
        on_cart, on_arm = (ModulatingFunctions(count, dt, width / frequency) for width in (_CART, _ARM))
    except ValueError:
        raise ValueError(
            f"experiment {experiment.name}: too short for test functions of {2 * _CART / frequency:.3g} s; record for longer."
        ) from None
    zero = np.zeros(count)
    q = channel(experiment, "cart_position")
    q = zero if q is None else q
    raw_angle, raw_omega = channel(experiment, "arm_angle"), channel(experiment, "arm_velocity")
    first = experiment.initial_arm_angle or 0.0
    if raw_angle is not None:
        angle = raw_angle
        slow = _smooth(raw_angle, 8 * _BAND * frequency * dt)
        omega = np.gradient(slow, dt) if raw_omega is None else raw_omega
    elif raw_omega is not None:
        omega, angle = raw_omega, integrated(raw_omega, first, dt)
    else:
        omega, angle = zero, zero + first
    from_angle = raw_angle is not None and raw_omega is None
    while levels is not None and on_arm.m >= 2 * _NARROWEST:
        narrower = ModulatingFunctions(count, dt, 0.5 * on_arm.m * dt)
        inertia = narrower(angle, 2) if from_angle else narrower(omega, 1)
        noise = narrower.noise(levels.get("arm_angle" if from_angle else "arm_velocity", 0.0), 2 if from_angle else 1)
        if noise**2 > _NOISY * np.mean(inertia**2):
            break
        on_arm = narrower
    band = min(0.33 / dt, _BAND * frequency)
    smooth = _smooth(q, band * dt) if np.any(q) else q
    velocity = CubicSpline(dt * np.arange(count), smooth)(dt * np.arange(count), 1)
    quick = (
        CubicSpline(dt * np.arange(count), _smooth(q, _QUICK * band * dt))(dt * np.arange(count), 1) if np.any(q) else q
    )
    turning = _smooth(omega, 8 * band * dt) if np.any(omega) else omega
    return WeakMotion(
        on_cart, on_arm, q, velocity, quick, angle, omega, turning, band,
        from_angle, raw_angle is not None or raw_omega is not None,
    )  # fmt: skip


def integrated_terms(
    experiment: Experiment,
    levels: Mapping[str, float],
    *,
    near_zero: float,
    dry_rate: float = 0.0,
    drive_rate: float = 0.0,
    motion: WeakMotion | None = None,
) -> Terms:
    """Return the terms of both equations against test functions, whose derivatives replace those of the measurements.

    The swinging arm's force is me times the second derivative of sin(theta), so it too goes over to the test function. The
    sign of the velocity is integrated exactly between the turns of the cart, and test functions that reach into a stretch
    where the cart hardly moves, as at the end of a decay, are not sliding.

    Args:
        experiment: free or forced.
        levels: noise of each channel, SI units.
        dry_rate: dry friction divided by mass [m/s^2], as far as it is known: the velocity has a kink of twice this slope at
            each turn, which smoothing would shift.
        drive_rate: torque constant divided by inertia [rad/s^2/A], as far as it is known: where a held current jumps, the
            arm's velocity has a kink.
        near_zero: a test function slides where the rms velocity over it is above this fraction of the largest.
        motion: of the experiment, where it is at hand with test functions of its own.

    Raises:
        ValueError: the experiment shows no cart position, or is shorter than two test functions.

    Source: Shinbrot, Trans. ASME 79 (1957), modulating functions; Preisig and Rippin, Comput. Chem. Eng. 17 (1993).
    """
    motion = weak_motion(experiment) if motion is None else motion
    dt = experiment.sample_time
    on_cart, on_arm, q, angle, omega, band = (
        motion.on_cart, motion.on_arm, motion.position, motion.angle, motion.omega, motion.band,
    )  # fmt: skip
    current = experiment.inputs.get("current")
    held = current is not None and current.intersample == "zoh"
    jumps = np.diff(current.values, prepend=current.values[:1]) if held and current is not None else np.zeros(len(q))
    inertia = on_arm(angle, 2) if motion.from_angle else on_arm(omega, 1)
    of_arm = ("arm_angle", 2) if motion.from_angle else ("arm_velocity", 1)
    distance = integrated_sign(motion.velocity, dt)
    for _ in range(_KINKS if dry_rate > 0 and np.any(q) else 0):
        rounded = _smooth(distance.values, band * dt)
        distance = integrated_sign(motion.velocity - dry_rate * (distance.values - rounded), dt)
    way = motion.turning > 0
    speed = on_cart.largest(motion.velocity)
    noise = levels.get("cart_position", 0.0) * 2 * np.pi * band * np.sqrt(2 * band * dt / 3)
    return Terms(
        name=experiment.name,
        cart={
            "mass": on_cart(q, 2),
            "viscous": on_cart(q, 1),
            "dry": on_cart(distance.integral, 2),
            "spring": on_cart(q),
            "swing": on_cart(np.sin(angle), 2),
            "force": on_cart.of_input(experiment.inputs.get("disturbance_force")),
        },
        arm={
            "inertia": inertia,
            # By parts once: the derivative of the test function times cos(theta), against the cart's velocity.
            "reaction": on_arm(motion.quick * np.cos(angle), 1) + on_arm(motion.quick * np.sin(angle) * omega),
            "current": on_arm.of_input(current) + on_arm.of_kinks(jumps, 1),
            "positive": on_arm(np.where(way, omega, 0.0)) + drive_rate * on_arm.of_kinks(np.where(way, jumps, 0.0), 0),
            "negative": on_arm(np.where(way, 0.0, omega)) + drive_rate * on_arm.of_kinks(np.where(way, 0.0, jumps), 0),
        },
        angle=angle[on_cart.middle],
        sliding=(speed > near_zero * np.max(speed, initial=0.0)) & (speed > _TRUSTED * noise),
        arm_free=experiment.arm == "free",
        has_arm=motion.has_arm,
        lag=on_arm.lag,
        noise=(on_cart.noise(levels.get("cart_position", 0.0), 2), on_arm.noise(levels.get(of_arm[0], 0.0), of_arm[1])),
        weight=float(np.sum(on_cart.weights[0])),
    )


@functools.lru_cache(maxsize=64)
def _sections(fraction: float) -> np.ndarray:
    return np.asarray(scipy.signal.butter(4, 2 * fraction, output="sos"))


def _smooth(values: Values, fraction: float) -> Values:
    """Return the signal below this fraction of the sampling rate, without delay."""
    fraction = min(fraction, 0.33)
    return scipy.signal.sosfiltfilt(_sections(fraction), values, padlen=min(len(values) - 1, math.ceil(4 / fraction)))


class _Distance(NamedTuple):
    """The integral of the sign of a velocity, and the integral of that, at the samples."""

    values: Values
    integral: Values


def integrated_sign(velocity: Values, dt: float) -> _Distance:
    """Integrate the sign of a velocity twice; exact where the velocity is a straight line between samples."""
    before, after = velocity[:-1], velocity[1:]
    turned = before * after < 0
    part = np.where(turned, np.abs(before) / np.where(turned, np.abs(before) + np.abs(after), 1.0), 1.0)
    sign = np.where(before != 0, np.sign(before), np.sign(after))
    values = np.concatenate([[0.0], np.cumsum(dt * sign * (2 * part - 1.0))])
    area = dt * values[:-1] + dt**2 * sign * (2 * part - part**2 - 0.5)
    return _Distance(values, np.concatenate([[0.0], np.cumsum(area)]))
