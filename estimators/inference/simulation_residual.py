"""The meaning of a simulation error beyond the noise: random forces, too few data, or what nobody explained."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from scipy.stats import chi2

if TYPE_CHECKING:  # a judgement of saved numbers needs no recording
    from rtac_jax.measurement import Recording

Cause = Literal["noise", "shaken", "too few data", "stand-in", "unexplained"]


@dataclasses.dataclass(frozen=True)
class SimulationLimits:
    """The thresholds by which a simulation error is judged.

    Attributes:
        beyond: squared error over the squared noise from which the model misses more than the sensors do: both are equally large
            at 2.
        poor: rms error over the rms of the motion from which a simulation is poor, whatever the reason: a fit of 90 % as in Ljung,
            System Identification (1999), section 16.5.
        large: random forces averaged over a radian of the cart's swing, over the rms forces, from which they are no small
            disturbance any more. Set between the shaken rigs of the study (0.005 to 0.01) and recordings with signs or units wrong
            (0.1 to 0.4).
        level: random forces carry a swing away by one amplitude and one phase for each experiment, so that its power scatters as
            chi-square of two degrees of freedom for each; at this level it is more than they explain. That a fit absorbs a part of
            it makes it cautious.
        unfollowed: rms error over the rms of the motion from which a simulation follows nothing. Moderate effects of the study
            reached 0.20 in 56 of 58 recordings (draws 201 and 202), gross ones 0.31 to 0.94.
        left: rms error over that which the random forces would leave, of all channels, below which such forces cannot act: a fit
            takes up a part of what they do, and left 0.25 or more where nothing was hidden (31 recordings of draws 160, 161), and
            0.05 of a measured pendulum with friction. Set on these; five shaken recordings of draws 163 to 167 left 0.23 to 0.53.
        consequence: rms error over the rms of the motion, below which it is asked of no channel whose noise nobody knows whether
            random forces could leave so little: an encoder of a micrometre tells 7e-5 of an axis' motion.
    """

    beyond: float = 2.0
    poor: float = 0.1
    large: float = 0.05
    level: float = 2e-3
    unfollowed: float = 0.25
    left: float = 0.1
    consequence: float = 0.01


STANDARD = SimulationLimits()
SHAKEN = 1e-2
"""Fraction of the rms forces from which random forces in one sample are worth a word."""
# Times the noise of the fastest changes that no sensor wanders by: one whose noise is correlated over a thousand samples does.
_NO_SENSOR = 30.0


@dataclasses.dataclass(frozen=True)
class SimulationResidual:
    """Error of a fitted simulation in the channel in which it is farthest beyond the noise.

    Attributes:
        cause: "noise" where no channel is beyond it; "shaken" where random forces explain it; "too few data" where so would an
            effect that the data are too few to confirm; "stand-in" where the random forces take the place of the model's own;
            "unexplained".
        channel: name of the output; empty where no noise is known and the simulation is not poor.
        ratio: rms error over the noise [1]; without a channel the largest.
        shaken_ratio: rms error over the noise that the random forces of the predictor would leave [1]; NaN if not known.
        signal_fraction: rms error over the rms of the signal [1].
        random_force, random_torque: in one sample, as fractions of the rms forces; NaN if not known.
        words: what is known, as one or two sentences; empty for "noise".
        noise_known: whether the channel's noise is known apart from any fit; else it is that of the fastest changes.
        of_the_current: whether the noise of a measured current is a random torque of that size.
        tested: whether tests of the innovations asked what is missing.
    """

    cause: Cause
    channel: str
    ratio: float
    shaken_ratio: float
    signal_fraction: float
    random_force: float
    random_torque: float
    words: str
    noise_known: bool = True
    of_the_current: bool = False
    tested: bool = True

    @property
    def vetoes(self) -> bool:
        """Return whether no model may be called adequate, and no agreement a confirmation, with such an error."""
        return self.cause not in ("noise", "shaken")

    @property
    def overstated(self) -> bool:
        """Return whether the random forces that the predictions ask for would leave so much more that they cannot act."""
        return self.cause == "unexplained" and self.shaken_ratio > self.ratio

    @property
    def headline(self) -> str:
        """Return the cause in one line, with the numbers that carry it."""
        said = {
            "noise": "The simulation follows the recording down to the noise",
            "shaken": "One sample ahead nothing is missing; random forces explain the simulation's error"
            if self.tested
            else "Random forces, or what they stand in for, explain the simulation's error",
            "too few data": "Too few data to tell a random force from a missing effect",
            "stand-in": "Random forces stand in for the physics",
            "unexplained": "Nothing explains the error of the simulation",
        }[self.cause]
        if not self.noise_known:
            return f"{said}: the simulation misses {percent(self.signal_fraction)} of the motion ({self.channel})"
        return f"{said}: {self.ratio:.2g} times the noise ({self.channel})"


def known_noise(recording: "Recording") -> frozenset[str]:
    """Return the channels whose noise is known apart from any fit: recorded at rest, or stated in the file."""
    return frozenset(
        channel
        for e in recording
        for channel, signal in e.outputs.items()
        if (e.kind == "rest" and signal.varies) or signal.noise_std is not None
    )


def judged_channels(residual_std: Mapping[str, float], recording: "Recording") -> tuple[list[str], bool]:
    """Return the channels whose simulation error is judged, and whether their noise is known: all of a fit, where none is.

    Args:
        residual_std: rms that the simulation of a fit leaves, by channel.
        recording: that was fitted.
    """
    known = [channel for channel in residual_std if channel in known_noise(recording)]
    return known or list(residual_std), bool(known)


def of_unknown_noise(residual_std: Mapping[str, float], recording: "Recording") -> tuple[str, ...]:
    """Return the channels whose noise nobody knows, where that of others is known."""
    judged, _ = judged_channels(residual_std, recording)
    return tuple(channel for channel in residual_std if channel not in judged)


def is_current_noise(
    random: tuple[float, float], noise: float, *, force: float = SHAKEN, times: float = STANDARD.beyond
) -> bool:
    """Return whether the noise of a measured current explains the random forces that a predictor asks for.

    Args:
        random: force and torque in one sample, as fractions of the rms forces; False if NaN.
        noise: the random torque that the noise of the current is, as the same fraction; zero where nothing shows any.
        force: fraction up to which a random force on the cart is next to nothing.
        times: power of the torque over that of the noise, up to which the noise explains it.
    """
    return noise > 0.0 and random[0] < force and random[1] ** 2 <= times * noise**2


def random_forces_are_large(
    random: tuple[float, float], samples_per_radian: float, limits: SimulationLimits = STANDARD
) -> bool:
    """Return whether random forces, averaged over a radian of the cart's swing, are no small disturbance any more.

    Args:
        random: force and torque in one sample as fractions of the rms forces; False if NaN.
        samples_per_radian: of the cart's natural swing.
        limits: from which on they are large.
    """
    return max(random) / samples_per_radian**0.5 > limits.large


def follows_nothing(
    unfollowed: float, random: tuple[float, float], samples_per_radian: float, limits: SimulationLimits = STANDARD
) -> bool:
    """Return whether a fit follows so little of the motion that its parameters mean nothing, and random forces replace the physics.

    Args:
        unfollowed: rms error of its simulation over the rms of the motion.
        random: force and torque of its predictor in one sample, as fractions of the rms forces.
        samples_per_radian: of the cart's natural swing.
        limits: from which on it is so.
    """
    return unfollowed > limits.unfollowed and random_forces_are_large(random, samples_per_radian, limits)


def simulation_residual(
    error: Mapping[str, float],
    shaken: Mapping[str, float],
    signal: Mapping[str, float],
    *,
    random: tuple[float, float],
    samples_per_radian: float,
    experiments: int,
    suspect: str = "",
    seconds: int = 0,
    noise_known: bool = True,
    unknown: Collection[str] = (),
    added: Sequence[str] = (),
    of_the_current: bool = False,
    tested: bool = True,
    limits: SimulationLimits = STANDARD,
) -> SimulationResidual:
    """Judge the simulation error of a fit.

    In this order: within the noise; random forces that take the place of the model's own, where they are large and the
    simulation is poor; more than random forces explain, or so much less that they cannot act; an effect of the catalogue that
    would explain it too, and that so few data cannot confirm; random forces.

    Where no noise is known apart from a fit, that of the fastest changes stands for it, which is less than there is where sensors
    wander slowly. Only a poor simulation is judged then, or one that is left at thirty times that, which no usual sensor makes, or
    at ten times that where an effect is suspected, or where the random forces would leave ten times more and a hundredth of the
    motion is missed; large random forces take the place of the model's own where a hundredth is, and nothing was added. So it is of
    a channel whose noise nobody knows beside others that are known: it tells only of random forces in place of the model's own.

    Args:
        error: rms over the noise, by channel.
        shaken: what the random forces of the predictor and the sensors would leave of it; empty if no predictor tells.
        signal: rms of the motion over the noise.
        random: force and torque in one sample as fractions of the rms forces; NaN if not known.
        samples_per_radian: of the cart's natural swing, over which random forces average.
        experiments: number of them.
        suspect: the effect that speaks loudest of those that the data are too few to confirm, with what it reaches.
        seconds: of data.
        noise_known: whether the noise of any channel is known apart from a fit.
        unknown: channels of which it is not, where it is of others.
        added: ids of the effects that the model has beside those of the fit that is diagnosed.
        of_the_current: whether the noise of a measured current is a random torque of the size that the predictor asks for.
        tested: whether effects were looked for in the predictions, and none is missing there.
        limits: the thresholds.
    """
    nothing = float("nan")
    away = {
        c: ratio
        for c, ratio in error.items()
        if ratio**2 > limits.beyond
        and (
            (noise_known and c not in unknown)
            or ratio > limits.poor * signal[c]
            or ratio > (1.0 / limits.left if suspect else _NO_SENSOR)
            or (
                ratio > max(1.0 / limits.left, limits.consequence * signal[c])
                and ratio < limits.left * shaken.get(c, 0.0)
                and not of_the_current
            )
        )
    }
    beyond = {c: ratio for c, ratio in away.items() if c not in unknown}
    if not error or not (away or noise_known):
        most = max(error.values(), default=nothing)
        return SimulationResidual("noise", "", most, nothing, nothing, *random, "", noise_known)

    def said(cause: Cause, channel: str) -> SimulationResidual:
        fraction = error[channel] / signal[channel]
        simulation = f"the simulation with {', '.join(added)}" if added else "the simulation"
        misses = f"{simulation} is {percent(fraction)} of the motion away from the recording ({channel})"
        if noise_known and channel not in unknown:
            misses += f", {error[channel]:.2g} times the known noise"
        by = shaken.get(channel, nothing)
        words = _words(
            cause, misses, error[channel], by, random, suspect, seconds, of_the_current=of_the_current, tested=tested
        )
        return SimulationResidual(
            cause, channel, error[channel], by, fraction, *random, words,
            noise_known and channel not in unknown, of_the_current, tested,
        )  # fmt: skip

    poorest = max(away, key=lambda c: away[c] / signal[c], default="")
    if (
        poorest
        and random_forces_are_large(random, samples_per_radian, limits)
        and away[poorest] > (limits.poor if noise_known or added else limits.consequence) * signal[poorest]
    ):
        return said("stand-in", poorest)
    if not beyond:
        judged = [c for c in error if c not in unknown]
        return said("noise", max(judged, key=lambda c: error[c]))
    farthest = max(beyond, key=lambda c: beyond[c])
    scatter = float(chi2.isf(limits.level, 2 * experiments)) / (2 * experiments)
    least = max(beyond, key=lambda c: beyond[c] / shaken.get(c, nothing) if c in shaken else float("inf"))
    if least not in shaken or not beyond[least] ** 2 <= scatter * shaken[least] ** 2:
        return said("unexplained", least)
    if not of_the_current and _fraction_left(beyond, shaken) < limits.left:
        return said("unexplained", min((c for c in beyond if c in shaken), key=lambda c: beyond[c] / shaken[c]))
    return said("too few data" if suspect else "shaken", farthest)


def _fraction_left(error: Mapping[str, float], shaken: Mapping[str, float]) -> float:
    """Return the rms error of a simulation over that which random forces would leave, of all channels beyond the noise together."""
    both = [c for c in error if c in shaken]
    would = sum(shaken[c] ** 2 for c in both)
    return (sum(error[c] ** 2 for c in both) / would) ** 0.5 if would > 0 else float("inf")


def percent(fraction: float) -> str:
    """Return a fraction in percent, with two digits where it is small."""
    return f"{100 * fraction:.0f} %" if fraction >= 0.1 else f"{100 * fraction:.2g} %"


def random_forces(random: tuple[float, float]) -> str:
    """Return random force and torque in words; one that is not worth a word, as on what is held, is left out beside the other."""
    parts = [(size, f"of the rms {name}") for size, name in zip(random, ("force", "torque"), strict=True)]
    told = [part for part in parts if part[0] >= SHAKEN] or parts
    return f"{' and '.join(f'{percent(size)} {of}' for size, of in told)} in one sample"


def _words(
    cause: Cause,
    misses: str,
    ratio: float,
    shaken: float,
    random: tuple[float, float],
    suspect: str,
    seconds: int,
    *,
    of_the_current: bool,
    tested: bool,
) -> str:
    if cause == "noise":
        return ""
    size = random_forces(random)
    if cause == "stand-in":
        return (
            f"Although predictions one sample ahead are at the noise, {misses}. Random forces stand in for the physics there"
            f" ({size}): the model's own forces are wrong, as by a sign, a unit, a constant of the rig, or a gross effect, or the"
            " rig is shaken as hard as that, which these data cannot tell from it."
        )
    if cause == "unexplained":
        if shaken != shaken:  # NaN
            return f"Unexplained: {misses}, and nothing says how much of that random forces would explain."
        would = f"The random forces that the predictions ask for ({size}) would leave {shaken:.2g} times the noise"
        if shaken > ratio:
            return (
                f"Unexplained: {misses}. {would}, far more, so no such forces act: they stand for what is missing and acts slowly,"
                " or for a sensor whose noise is correlated."
            )
        return f"Unexplained: {misses}. {would}, so they do not explain it."
    if cause == "too few data":
        return (
            f"Too few data: {misses}. Random forces ({size}) would explain that, and so might {suspect}; {seconds} s of data are"
            " too few to tell a random force from a missing effect."
        )
    why = (
        f"the rig is shaken, or they {'hide what is smaller' if tested else 'stand in for what a diagnosis would find'}"
    )
    if of_the_current:
        why = "the measured current has noise that shakes the model as much, so nothing else need be"
    said = f"One sample ahead nothing is missing. Even so, {misses}" if tested else f"{misses[0].upper()}{misses[1:]}"
    return (
        f"{said}, as random forces of the size that the predictions ask for would leave it ({shaken:.2g} times the noise; {size}):"
        f" {why}."
    )
