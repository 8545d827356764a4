"""Frequency responses of every condition without a model: best linear approximation, noise and distortion apart."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from estimators.frequency_response.angle_reconstruction import arm_angles
from estimators.frequency_response.feedback import feedback
from estimators.frequency_response.periodic import Lines, periodic_response, repeated_input
from estimators.frequency_response.response import FrequencyResponse, FrequencyResponses
from estimators.frequency_response.spectra import Spectra, fit_lines, spectra
from rtac_jax import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import INPUTS, OUTPUTS, Experiment, Recording

_SHOWN = (3, 0.3)  # so many lines have to be as certain, standard deviation over magnitude
_HALF_WIDTH = 12
_DEGREE = 2
_POLES = 2


@checked_arguments
def frequency_responses(
    recording: Recording,
    *,
    input: str = "current",
    output: str = "cart_position",
    compensate: bool = True,
    method: str | None = None,
    period: int | None = None,
    discard: int = 0,
    band: tuple[float | int, float | int] | None = None,
    frequency: Float64[np.ndarray, " frequency"] | None = None,
    half_width: int = _HALF_WIDTH,
    degree: int = _DEGREE,
    poles: int = _POLES,
    realisations: Mapping[str, Sequence[str]] | None = None,
    angles: Mapping[str, Float64[np.ndarray, " sample"]] | None = None,
    model: RTAC | None = None,
) -> FrequencyResponses:
    """Estimate the frequency response of every forced experiment, with its standard deviation at each frequency.

    With `compensate` the response is that of Fig. 3, from x = input * cos(theta) to the output, which does not depend on
    where the arm stands; `FrequencyResponse.actual` puts cos(theta_0) back. The angle is measured, or else given, or from
    a model, or integrated; see `arm_angles`. Nothing is detrended.

    Two methods: "periodic" takes the harmonics of an input that repeats, and tells noise (what differs between periods)
    from nonlinear distortion (what repeats at harmonics that were not excited); a transient is taken off by what stands between
    the harmonics, also one that rings on beyond the record. "local" takes any input: polynomials and fractions over neighbouring
    lines, with the transient as a part of its own; noise and distortion are not told apart.

    Args:
        recording: with forced experiments.
        input: name of the input channel.
        output: name of the output channel.
        compensate: count cos(theta) as part of the input.
        method: by default "periodic" where `period` is given and the input, compensated or not, repeats.
        period: of the input, in samples.
        discard: samples at the start that are left out.
        band: [Hz]; by default where the input has lines.
        frequency: [rad/s] the frequencies of the result, for "local"; by default every line in the band.
        half_width: of the local fit, see `local_response`. The window spans `2 half_width + 1` lines of
            1 / duration.
        degree: of the local fit's polynomials, or of the transient's.
        poles: of the local fit.
        realisations: experiments that show one condition with different multisines, by name of the condition; their mean
            is the response and their scatter the distortion. By default each forced experiment is a condition.
        angles: theta(t) [rad] by name of experiment.
        model: simulates theta(t) where it is neither measured nor given.

    Returns:
        One response for each condition, in the order of the recording.

    Raises:
        ValueError: a channel that no or not every experiment has or that is constant, an input that does not repeat where
            periods are needed, a record with fewer than two periods, an excitation that vanishes on a line asked for, or a
            response that drowns in noise.
    """
    for option, name, known in (("input", input, INPUTS), ("output", output, OUTPUTS)):
        if name not in known:
            raise ValueError(f"{option}: there is no channel {name!r}; use one of {', '.join(known)}.")
    if method not in (None, "periodic", "local"):
        raise ValueError(f"method: is {method!r}; use 'periodic' or 'local'.")
    groups = _groups(recording, realisations)
    turned = arm_angles(recording, [n for names in groups.values() for n in names], angles, model) if compensate else {}
    ready: dict[str, Lines | Spectra] = {}
    answers: dict[str, float] = {}
    for name in dict.fromkeys(n for names in groups.values() for n in names):
        experiment = recording[name]
        into, out = _signals(experiment, input, output, discard)
        theta = turned.get(name)
        x = into if theta is None else into * _between(np.cos(theta))[discard:]
        answers[name] = feedback(into, x, out, held=experiment.inputs[input].intersample == "zoh")
        repeats = period is not None and repeated_input(x, period) is not None
        if method == "periodic" or (method is None and repeats):
            ready[name] = _periodic(experiment, x, out, period, into, degree, band)
        else:
            ready[name] = spectra(experiment, x, out, into, band, frequency, half_width)
    lines_of = {name: _held(one) for name, one in fit_lines(ready, half_width, degree, poles).items()}
    found = []
    for condition, names in groups.items():
        each = [_continuous(lines_of[name], recording[name], input) for name in names]
        start = recording[names[0]].initial_arm_angle
        angle = None if turned.get(names[0]) is None else float(np.mean(turned[names[0]][discard:]))
        rms = float(np.sqrt(np.mean([np.mean(recording[n].inputs[input].values[discard:] ** 2) for n in names])))
        one = _condition(condition, each, rms, start if angle is None else angle, compensate, (input, output))
        check_shown(one)
        found.append(dataclasses.replace(one, feedback=max(answers[name] for name in names)))
    return FrequencyResponses(tuple(found))


def condition_responses(
    recording: Recording,
    names: Sequence[str],
    *,
    frequency: Float64[np.ndarray, " frequency"],
    half_width: Mapping[str, int],
) -> dict[str, FrequencyResponse | ValueError]:
    """Return what `frequency_responses` gives of each experiment by "local" on one grid, or why it gives nothing.

    Args:
        recording: with these experiments, and those at rest that tell the tachometer's bias.
        names: of the experiments, each a condition.
        frequency: [rad/s] the grid.
        half_width: of the local fit, by name.
    """
    found: dict[str, FrequencyResponse | ValueError] = {}
    ready: dict[str, Spectra] = {}
    angles: dict[str, np.ndarray] = {}
    answers: dict[str, float] = {}
    for name in names:
        experiment = recording[name]
        try:
            angles |= arm_angles(recording, [name])
            into, out = _signals(experiment, "current", "cart_position", 0)
            x = into * _between(np.cos(angles[name]))
            answers[name] = feedback(into, x, out, held=experiment.inputs["current"].intersample == "zoh")
            ready[name] = spectra(experiment, x, out, into, None, frequency, half_width[name])
        except ValueError as error:
            found[name] = error
    for width in sorted(set(half_width.values())):
        alike = {name: one for name, one in ready.items() if half_width[name] == width}
        try:
            fitted = fit_lines(alike, width, _DEGREE, _POLES)
        except ValueError:  # a record is too short for this width
            fitted = {}
            for name, one in alike.items():
                try:
                    fitted |= fit_lines({name: one}, width, _DEGREE, _POLES)
                except ValueError as error:
                    fitted[name] = error
        for name, lines in fitted.items():
            experiment = recording[name]
            try:
                each = [_continuous(_held(lines), experiment, "current")]
                rms = float(np.sqrt(np.mean(experiment.inputs["current"].values ** 2)))
                angle = float(np.mean(angles[name]))
                one = _condition(name, each, rms, angle, True, ("current", "cart_position"))
                check_shown(one)
                found[name] = dataclasses.replace(one, feedback=answers[name])
            except ValueError as error:
                found[name] = error
    return {name: found[name] for name in names}


def _held(lines: Lines | ValueError) -> Lines:
    if isinstance(lines, ValueError):
        raise lines
    return lines


def _groups(recording: Recording, realisations: Mapping[str, Sequence[str]] | None) -> dict[str, list[str]]:
    if realisations is not None:
        for condition, names in realisations.items():
            for name in names:
                if name not in recording.names:
                    raise ValueError(f"realisations: {condition} names {name}, which is not in the recording.")
        return {condition: list(names) for condition, names in realisations.items()}
    groups = {e.name: [e.name] for e in recording if e.kind == "forced"}
    if not groups:
        raise ValueError("the recording has no forced experiment; a frequency response needs an input.")
    return groups


def _signals(experiment: Experiment, into: str, out: str, discard: int) -> tuple[np.ndarray, np.ndarray]:
    place = f"/experiments/{experiment.name}"
    if into not in experiment.inputs or out not in experiment.outputs:
        raise ValueError(
            f"{place}: has no {into if into not in experiment.inputs else out}; leave it out or record it."
        )
    if not 0 <= discard < experiment.samples - 8:
        raise ValueError(f"discard: {discard} of the {experiment.samples} samples of {experiment.name} leave too few.")
    u, y = experiment.inputs[into].values[discard:], experiment.outputs[out].values[discard:]
    if np.any(np.isnan(y)):
        raise ValueError(f"{place}/outputs/{out}: has missing samples; a spectrum needs all of them, so cut there.")
    for channel, values in ((into, u), (out, y)):
        if np.ptp(values) == 0:
            raise ValueError(f"{place}: {channel} is constant at {values[0]:g}, so it shows no response; leave it out.")
    return u, y


def _between(cosine: np.ndarray) -> np.ndarray:
    """Return the mean over the interval that follows each sample, in which the input is held."""
    return 0.5 * (cosine + np.append(cosine[1:], cosine[-1]))


def _periodic(
    experiment: Experiment, x: np.ndarray, y: np.ndarray, period: int | None, raw: np.ndarray, degree: int,
    band: tuple[float | int, float | int] | None,
) -> Lines:  # fmt: skip
    place = f"/experiments/{experiment.name}"
    if period is None or len(x) // max(period, 1) < 2:
        raise ValueError(
            f"{place}: the periodic method needs a period with at least two of them in {len(x)} samples; give period, or use "
            "method='local'."
        )
    repeated = repeated_input(raw, period)
    if repeated is None:
        raise ValueError(
            f"{place}: the input does not repeat every {period} samples; correct period, or use method='local'."
        )
    return periodic_response(
        place, x, y, repeated, period=period, sample_time=experiment.sample_time, degree=degree, band=band
    )


class DrownedError(ValueError):
    """A response that is noise."""


def check_shown(one: FrequencyResponse) -> None:
    """Refuse a response that is noise, of which hardly a line has a standard deviation much smaller than the response."""
    count, most = _SHOWN
    surest = np.sort(one.std / np.maximum(np.abs(one.response), 1e-300))[:count]
    if surest[-1] > most:
        raise DrownedError(
            f"/experiments/{one.name}: the excitation hardly moves {one.output}: next to no line is known to within "
            f"{100 * most:.0f} %, as in noise; play a larger input or record for longer, or where the arm has wound up one that "
            "leaves it where it started."
        )


def _continuous(lines: Lines, experiment: Experiment, channel: str) -> Lines:
    """Return the response of the continuous-time system: the hold between samples is taken out.

    What the hold puts beyond half the sampling rate is neglected, as the rig does not follow that fast.
    """
    hold = experiment.inputs[channel].intersample
    phase = 0.5 * lines.frequency * experiment.sample_time
    shape = np.sinc(phase / np.pi)
    factor = {"zoh": shape * np.exp(-1j * phase), "foh": shape**2 + 0j}.get(str(hold), np.ones_like(shape) + 0j)
    size = np.abs(factor)

    def scaled(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values / size

    return lines._replace(
        response=lines.response / factor, std=lines.std / size, noise_std=lines.noise_std / size,
        odd=scaled(lines.odd), even=scaled(lines.even),
    )  # fmt: skip


def _condition(
    name: str, each: list[Lines], rms: float, angle: float | None, compensated: bool, channels: tuple[str, str]
) -> FrequencyResponse:
    first = each[0]
    if any(len(e.frequency) != len(first.frequency) or not np.allclose(e.frequency, first.frequency) for e in each):
        raise ValueError(
            f"realisations: those of {name} have different lines; give them one length and period, or give frequency."
        )
    response = np.mean([e.response for e in each], axis=0)
    noise = np.sqrt(np.mean([e.noise_std**2 for e in each], axis=0) / len(each))
    std, freedom, odd, even = (
        np.sqrt(np.mean([e.std**2 for e in each], axis=0) / len(each)),
        first.freedom,
        first.odd,
        first.even,
    )
    if len(each) > 1:
        # What differs between realisations is noise and distortion together, whatever the harmonics.
        scatter = np.sum([np.abs(e.response - response) ** 2 for e in each], axis=0) / (len(each) - 1)
        std, freedom = np.sqrt(scatter / len(each)), len(each) - 1
        odd, even = (
            (None if first.odd is None else _mean_level([e.odd for e in each])),
            (None if first.even is None else _mean_level([e.even for e in each])),
        )
    return FrequencyResponse(
        name=name, frequency=first.frequency, response=response, std=std, noise_std=noise, freedom=freedom,
        odd_distortion=odd, even_distortion=even, coherence=np.mean([e.coherence for e in each], axis=0),
        input_rms=rms, arm_angle=angle, compensated=compensated, input=channels[0], output=channels[1],
    )  # fmt: skip


def _mean_level(levels: Sequence[Float64[np.ndarray, " frequency"] | None]) -> np.ndarray:
    return np.sqrt(np.mean([level**2 for level in levels if level is not None], axis=0))
