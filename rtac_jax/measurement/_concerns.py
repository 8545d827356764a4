"""Concerns about a recording. Every judgement is a guess from the data; nothing is changed by it."""

from collections.abc import Callable, Collection, Iterator

import numpy as np
import scipy.ndimage
from jaxtyping import Float64

from rtac_jax.arguments import checked_arguments

from ._channel_checks import channel_concerns, jumps, rest_concerns, turns_fast, unit_concerns
from ._differenced_counts import counts_differenced
from ._experiment import Experiment
from ._input_noise import current_noise, noise_level
from ._momentary_faults import momentary_faults, resolution
from ._recording import POSITIVE, Recording
from ._signal import OUTPUTS, Signal
from ._unsigned_velocity import returns_unsigned
from ._velocity_at_rest import read_at_rest

SHOWN_NAMES = 6
SHORT_SAMPLES = 100
SHORT_PERIODS = 3
SAMPLES_PER_PERIOD = 20
OUTLIER_SIGMAS = 10
OUTLIER_WINDOW = 51
MOVING_SIGMAS = 2  # times the noise from which on a channel moves: three quarters of its power are motion
# From the median of absolute values to the standard deviation, for Gaussian noise.
MEDIAN_TO_STD = 1.4826
# Samples: dry friction that begins with the input holds for no time, and a drive is late by a few.
_WAITS = 20
# Fraction of the samples from which turns of more than half a turn from one to the next are worth a word: a fault or two is less.
_JUMPS = 0.01
STILL = 0.05  # of the largest, below which a velocity, or a step of a position, is of what does not move yet
FASTEST = 1e-6  # s between samples, below which no drive or sensor of a rig is read
# Ratio of stated noise: where half of the samples have either, equal weights make deviations larger by 8 %.
UNEQUAL_NOISE = 1.5


@checked_arguments
def concerns(recording: Recording) -> list[str]:
    """Return what looks wrong with `recording`, one sentence each; empty when nothing does."""
    with np.errstate(all="ignore"):
        noisy, counting = current_noise(recording.experiments), _counting(recording)

        def of(experiment: Experiment) -> Iterator[str]:
            return _about_experiment(experiment, only_noise=experiment.name in noisy, counting=counting)

        several = [*_about_recording(recording), *contradictions(recording), *_by_sentence(recording, of)]
        return several if not noisy else [*several, _of_noisy_inputs(noisy)]


def _of_noisy_inputs(noisy: dict[str, float]) -> str:
    """Return what is to be done about currents that look like noise."""
    return (
        f"{_listed(list(noisy))}: the current looks like noise of {noise_level(noisy):.2g} A rms, as where it is measured; if"
        " it was played, set the kind to forced. An input with noise shakes the model as a random torque would, and a fit by"
        " simulation, which knows"
        " none, ends beside the truth: give the command, where the current follows it, or take the estimates of the prediction"
        " error (est.prediction_error_nonlinear, rtac fit)."
    )


def contradictions(recording: Recording) -> list[str]:
    """Return those of the concerns that no rig explains: channels that contradict each other, faults, and motion at rest."""
    # Numbers as large as 1e300 may overflow when they are squared, and nothing is said of them then.
    with np.errstate(all="ignore"):
        return [*rest_concerns(recording), *unit_concerns(recording), *_by_sentence(recording, _contradictions_of)]


def _by_sentence(recording: Recording, of: Callable[[Experiment], Iterator[str]]) -> list[str]:
    """Return what is said of each experiment; the same concern about many of them is one sentence that lists them."""
    places: dict[str, list[str]] = {}
    for experiment in recording:
        for sentence in of(experiment):
            places.setdefault(sentence, []).append(experiment.name)
    return [f"{_listed(names)}: {sentence}" for sentence, names in places.items()]


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:SHOWN_NAMES])
    return shown if len(names) <= SHOWN_NAMES else f"{shown} and {len(names) - SHOWN_NAMES} more"


def _about_recording(recording: Recording) -> Iterator[str]:
    outputs = [signal for experiment in recording for signal in experiment.outputs.values()]
    at_rest = any(experiment.kind == "rest" for experiment in recording)
    if not at_rest and any(signal.noise_std is None for signal in outputs):
        yield (
            "There is no experiment at rest and not every output has noise_std, so the noise must be "
            "estimated from the fit and a poor fit looks like noise; record some seconds with nothing moving."
        )
    force = any(
        signal.values.any() for e in recording for name, signal in e.inputs.items() if name == "disturbance_force"
    )
    if not force and not any(name in recording.rig for name in POSITIVE):
        yield (
            "The scale is not fixed: no mass, inertia, stiffness or torque constant is known and no force "
            "was measured, so only ratios of parameters can be found; weigh the cart (total_mass) or give "
            "arm_inertia."
        )
    for channel, levels in _stated_levels(recording).items():
        quiet, loud = min(levels, key=lambda name: levels[name]), max(levels, key=lambda name: levels[name])
        if levels[loud] > UNEQUAL_NOISE * levels[quiet]:
            yield (
                f"The stated noise of {channel} differs between experiments, from {levels[quiet]:.3g} in {quiet} to "
                f"{levels[loud]:.3g} in {loud}, and whatever fits them takes one level for all, the root mean square: the noisier "
                "ones count too much, standard deviations are not those of the quieter ones, and a diagnosis judges by that "
                "level; fit experiments of one level at a time (Recording.select)."
            )
    if hum := recording.hum():
        yield (
            f"Hum of the mains is in {' and '.join(map(str, hum))}: shield the sensor. The command line and est.improve subtract "
            "it; other calls take it for noise, or for what is missing, unless they are given recording.without_hum()."
        )
    if _never_moves(recording, "cart_position"):
        yield (
            "cart_position is no louder in any experiment than at rest: dry friction holds the cart, so nothing can be learned of"
            " it; drive it harder, or record a decay from far off."
        )
    if zeroed := _zeroed(recording):
        yield (
            f"arm_angle begins at exactly 0 in {_listed(zeroed)}, as where an incremental encoder is zeroed at every start; unless "
            "the arm began in one place each time, its zero differs between experiments, which no effect of the catalogue "
            "explains: turn the arm to one mark before the encoder is zeroed, or add the angle at which it began."
        )
    if all(experiment.kind == "rest" for experiment in recording):
        yield "All experiments are at rest, so there is nothing to fit; record free or forced ones."


def _never_moves(recording: Recording, name: str) -> bool:
    """Return whether an output was recorded at rest, and no experiment shows more than that."""
    loudest: dict[bool, float] = {}
    for experiment in recording:
        signal = experiment.outputs.get(name)
        if signal is not None and not experiment.holds(name):
            rests = experiment.kind == "rest"
            loudest[rests] = max(loudest.get(rests, 0.0), float(np.nanstd(signal.values)))
    return len(loudest) == 2 and loudest[False] <= MOVING_SIGMAS * loudest[True]


def _zeroed(recording: Recording) -> list[str]:
    """Return the names of moving experiments whose free arm begins at exactly zero, if that is so of all, and they are several."""
    turning = [e for e in recording if e.kind != "rest" and e.arm != "locked" and "arm_angle" in e.outputs]
    if len(turning) < 2 or any(e.outputs["arm_angle"].values[0] != 0 for e in turning):
        return []
    return [e.name for e in turning]


def _stated_levels(recording: Recording) -> dict[str, dict[str, float]]:
    """Return the stated noise of each output by experiment, where no record at rest decides."""
    found: dict[str, dict[str, float]] = {}
    for experiment in recording:
        for name, signal in experiment.outputs.items():
            if signal.noise_std is not None:
                found.setdefault(name, {})[experiment.name] = signal.noise_std
    resting = {name for experiment in recording if experiment.kind == "rest" for name in experiment.outputs}
    return {name: levels for name, levels in found.items() if name not in resting}


def _counting(recording: Recording) -> set[str]:
    """Return the outputs that move in steps, as an encoder's: constant is what they are at rest."""
    moving = [(name, signal) for e in recording if e.kind != "rest" for name, signal in e.outputs.items()]
    return {name for name, signal in moving if resolution(signal.values[~np.isnan(signal.values)]) > 0}


def _about_experiment(experiment: Experiment, *, only_noise: bool, counting: Collection[str]) -> Iterator[str]:
    """Yield what looks wrong with an experiment.

    Args:
        experiment: at rest or moving.
        only_noise: whether its current is nothing but noise.
        counting: outputs that move in steps.
    """
    driven = {name for name, signal in experiment.inputs.items() if signal.values.any()}
    at_rest, locked, clamped = (
        experiment.kind == "rest",
        experiment.arm == "locked",
        experiment.cart == "clamped",
    )
    if driven and experiment.kind != "forced" and not (only_noise and driven == {"current"}):
        yield (f"an experiment of kind {experiment.kind} has an input that is not zero; set its kind to forced.")
    if not at_rest and locked and clamped:
        yield "arm and cart are both held, so it says nothing about the rig; use kind rest, or leave it out."
    elif experiment.kind == "forced" and locked and driven == {"current"}:
        yield "the current cannot move a locked arm, so it cannot be used as forced; set its kind to free."
    elif not at_rest and all(experiment.holds(name) for name in experiment.outputs):
        yield "only what is held was measured, so it cannot be used; leave it out."
    if not at_rest and not clamped and "cart_position" not in experiment.outputs:
        yield (
            "cart_position was not measured, so the cart's friction, the spring and the mass show only through the arm; "
            "record it."
        )
    if not at_rest and not locked and "arm_angle" not in experiment.outputs:
        yield ("arm_angle was not measured, so the angle comes from the model and depends on where the arm started.")
        if experiment.initial_arm_angle is None:
            yield ("initial_arm_angle is not given either, so the starting angle must be estimated; note it next time.")
    if experiment.kind == "forced" and (driven := _driven_before_it_moves(experiment)) is not None:
        stepped, waits = driven
        yield (
            f"the {stepped} is on from its first sample, at which nothing moves yet, so that what came before is not on record and"
            " is taken for the same: a delay or a lag shows in nothing, and bends what is estimated; record from before the step,"
            " or put the zeros that came before it into the file."
        )
        if waits >= _WAITS:
            seconds = waits * experiment.sample_time
            yield (
                f"nothing moves for {seconds:.3g} s while the {stepped} stays the same, and then it does: what moved it came later"
                f" than the {stepped} on record; leave these {waits} samples out (--start of rtac import), or mend the clock."
            )
    if clamped and turns_fast(experiment):
        yield (
            "the arm turns by more than half a turn from one sample to the next: a fast motor that is sampled slowly, or"
            " sample_time is in ms, or arm_velocity in deg/s or rpm; see that both are in SI units."
        )
    if (fraction := jumps(experiment)) > _JUMPS:
        yield (
            f"arm_angle changes by more than half a turn from one sample to the next in {100 * fraction:.0f} % of the samples:"
            " it may be in degrees (nothing else shows its scale), or wrapped, or sampled slowly; give it in radians, unwrapped."
        )
    if experiment.sample_time < FASTEST:
        yield (
            f"it has a sample every {experiment.sample_time:.3g} s, which no rig is read at: the times may be in another unit than"
            " was taken; state theirs as in 't [s]'."
        )
    if experiment.samples < SHORT_SAMPLES:
        yield f"it has fewer than {SHORT_SAMPLES} samples, which is little to fit; record for longer."
    if times := returns_unsigned(experiment):
        yield (
            f"arm_velocity comes to nothing {times} times and is never negative, though the input changes its sign, as of a sensor "
            "that counts pulses; give it the sign of the motion, or leave it out."
        )
    if counts := counts_differenced(experiment):
        yield (
            f"arm_velocity moves in steps of a {counts}th of a turn in a sample, as an encoder's counts that are differenced: late"
            " by half of what they are taken over, and with errors that are not independent; give the counts as arm_angle in its"
            " place, or what the velocity sums to."
        )
    for name, signal in experiment.outputs.items():
        about = _about_output(signal, at_rest, experiment.holds(name), counts=name in counting)
        yield from (f"{name} {sentence}" for sentence in about)
        if (at_rest or experiment.holds(name)) and name == "arm_velocity" and (read := read_at_rest(signal)):
            yield (
                f"{name} reads {read} though the arm stands still: the sensor's zero is off; subtract that from all experiments"
                " alike, or let est.diagnose add tacho_bias."
            )
        if not at_rest and not experiment.holds(name) and name != "arm_angle" and _moves(signal.values):
            yield from (f"{name} {sentence}" for sentence in _about_sampling(signal, experiment))


def _contradictions_of(experiment: Experiment) -> Iterator[str]:
    if experiment.kind == "rest":
        return
    yield from channel_concerns(experiment)
    for name, signal in experiment.outputs.items():
        if not experiment.holds(name):
            yield from (f"{name} {sentence}" for sentence in momentary_faults(name, signal))


def _moves(values: Float64[np.ndarray, " sample"]) -> bool:
    """Return whether a channel shows more than noise, whose spectrum has no frequency that dominates."""
    present = values[~np.isnan(values)]
    return float(np.std(present)) > MOVING_SIGMAS * _noise_level(present)


def _about_output(signal: Signal, at_rest: bool, held: bool, *, counts: bool) -> Iterator[str]:
    missing = np.isnan(signal.values)
    if missing.any():
        yield f"has {100 * missing.mean():.2g} % of its samples missing."
    values = signal.values[~missing]
    spread = float(np.ptp(values))
    if spread == 0:
        if (held or at_rest) and not counts:
            yield ("is exactly constant, so it says nothing about the noise; check that the sensor was connected.")
        return
    step = _level_distance(values, spread)
    noise = signal.noise_std or _noise_level(values)
    if step is not None and step > 2 * noise:
        yield (
            f"is quantised in steps of {step:.3g} {signal.unit}, coarse next to its noise; use a finer range or more counts."
        )
    spikes = _spikes(values, max(resolution(values), 1e-9 * spread))
    if len(spikes):
        where = np.flatnonzero(~missing)[spikes[0]]
        yield (
            f"has {len(spikes)} suspicious outlier{'s' * (len(spikes) != 1)}, the first at sample {where}; replace them by NaN if "
            "they are faults."
        )


def _driven_before_it_moves(experiment: Experiment) -> tuple[str, int] | None:
    """Return an input that begins at half of its largest value or more where outputs rest, and for how many samples both stay.

    None where there is none. Where the input changes before anything moves no samples are told: friction may have held it until
    then.
    """
    speeds = [
        signal.values if name == "arm_velocity" else np.diff(signal.values)
        for name, signal in experiment.outputs.items()
        if not experiment.holds(name)
    ]
    sizes = [np.nanmax(np.abs(speed), initial=0.0) for speed in speeds]
    moved = [abs(speed[0]) > STILL * size for speed, size in zip(speeds, sizes, strict=True) if size > 0]
    if not moved or any(moved):
        return None
    several = [(np.abs(speed) > STILL * size) for speed, size in zip(speeds, sizes, strict=True) if size > 0]
    waits = min(int(np.argmax(one)) for one in several)
    for name, signal in experiment.inputs.items():
        first = signal.values[:3]
        if abs(first[0]) > 0.5 * np.max(np.abs(signal.values)) > 0 and np.all(first == first[0]):
            return name, waits if np.all(signal.values[: waits + 1] == first[0]) else 0
    return None


def _about_sampling(signal: Signal, experiment: Experiment) -> Iterator[str]:
    frequency = _dominant_frequency(signal.values, experiment.sample_time)
    if frequency * experiment.sample_time * SAMPLES_PER_PERIOD > 1:
        yield (
            f"is sampled fewer than {SAMPLES_PER_PERIOD} times in a period of its dominant {frequency:.3g} "
            "Hz; sample faster."
        )
    # Only the cart has a spring, and so a rhythm: a free arm drifts.
    rhythm = signal.unit == OUTPUTS["cart_position"]
    if rhythm and experiment.kind == "free" and frequency * experiment.duration < SHORT_PERIODS:
        yield f"covers fewer than {SHORT_PERIODS} periods of its dominant frequency; record for longer."


def _level_distance(values: Float64[np.ndarray, " sample"], spread: float) -> float | None:
    """Return the distance of neighbouring levels [unit] if values recur so much that they must be quantised."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > 1e-9 * spread]
    if not len(gaps) or len(gaps) > 0.2 * len(values):
        return None
    # A cart that has stopped repeats one value without being quantised; levels are all equally far apart.
    step = float(gaps.min())
    multiples = gaps / step
    return step if np.mean(np.abs(multiples - np.round(multiples)) < 0.05) > 0.95 else None


def _noise_level(values: Float64[np.ndarray, " sample"]) -> float:
    # The hundredth part that is largest may be faults. A median would not do: of a quantised signal it is a
    # level.
    bend = np.sort(np.abs(np.diff(values, 2)))
    return float(np.sqrt(np.mean(bend[: max(1, len(bend) * 99 // 100)] ** 2) / 6))


def _spikes(values: Float64[np.ndarray, " sample"], floor: float) -> np.ndarray:
    """Return indices of single samples far off the line through their neighbours, compared with how it is nearby."""
    bend = np.diff(values, 2)
    size = np.abs(bend)
    if len(bend) < 5:
        return np.array([], dtype=np.int64)
    # Nearby, since a decaying oscillation bends far more at its start than at its end.
    scale = MEDIAN_TO_STD * scipy.ndimage.median_filter(size, min(OUTLIER_WINDOW, len(size)), mode="reflect")
    # A flicker of two counts bends by four, however still the rest is, and however counts were scaled and rounded since.
    steps = np.abs(np.diff(values))
    limit = np.maximum(OUTLIER_SIGMAS * np.maximum(scale, floor), 4.0 * np.min(steps, initial=np.inf, where=steps > 0))
    # A lone fault bends 1, -2, 1; a jump of the current or of the friction bends one way only.
    opposite = np.minimum(-bend[:-2] * np.sign(bend[1:-1]), -bend[2:] * np.sign(bend[1:-1])) > 0.25 * size[1:-1]
    return np.flatnonzero((size[1:-1] > limit[1:-1]) & opposite) + 2


def _dominant_frequency(values: Float64[np.ndarray, " sample"], sample_time: float) -> float:
    """Return the frequency [Hz] of the largest peak of the spectrum."""
    present = np.flatnonzero(~np.isnan(values))
    filled = np.interp(np.arange(len(values)), present, values[present])
    power = np.abs(np.fft.rfft((filled - filled.mean()) * np.hanning(len(filled)))) ** 2
    return float(np.argmax(power)) / (len(filled) * sample_time)
