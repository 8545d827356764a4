"""Simulation error: a model's free simulation against the measurements, per channel and experiment, and residual tests."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.fft import next_fast_len
from scipy.signal.windows import parzen
from scipy.stats import chi2, norm

from estimators.core.active_bounds import solve_bounded
from estimators.core.data import CHANNELS, Data, mark_of, moving
from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.core.initial_rest import at_rest, best_starts, may_swing, squares
from estimators.core.initial_state import space_of
from estimators.core.levenberg_marquardt import Arguments, plain_residual
from estimators.core.parameter_space import Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.core.result_base import Result
from estimators.core.results import DivergedError
from estimators.core.sensor_noise import noise_levels
from estimators.core.step_size import accurate_substeps
from estimators.validation.extrapolation import beyond
from rtac_jax import RTAC, require_configured
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.overview import Overview

# Longer experiments without memory of their start take it from their beginning alone.
_LONG, _BEGINNING = 8192, 2048
_NOISE = 1.2  # mean square of an error over its noise, from which on a start is sought elsewhere
_LOST = 1e100  # an output beyond this has left all bounds, and its square would overflow

Values = Float[np.ndarray, " sample"]


@dataclasses.dataclass(frozen=True)
class Trace:
    """The measurement of one channel of one experiment beside its simulation.

    Attributes:
        experiment, channel: names.
        time: [s].
        measured, simulated: SI units; NaN where nothing was measured.
        current: motor current or, without one, the disturbance force, for the cross-correlation.
        used: whether a sample counts in the error (those that only set the start do not).
        noise: standard deviation of the sensor's noise.
    """

    experiment: str
    channel: str
    time: Values
    measured: Values
    simulated: Values
    current: Values
    used: Any
    noise: float

    @property
    def residual(self) -> Values:
        """Measured less simulated, NaN where it does not count."""
        return np.where(self.used, self.measured - self.simulated, np.nan)

    @property
    def rms(self) -> float:
        """Root mean square of the residual, SI units."""
        return float(np.sqrt(np.nanmean(self.residual**2)))

    @property
    def fit_percent(self) -> float:
        """100 (1 - |y - yhat| / |y - mean y|); minus infinity for a constant output."""
        measured = np.where(self.used, self.measured, np.nan)
        spread = np.sqrt(np.nanmean((measured - np.nanmean(measured)) ** 2))
        return float(100 * (1 - self.rms / spread)) if spread > 0 else float("-inf")

    def autocorrelation(self, lags: int = 50) -> tuple[Float[np.ndarray, " lag"], float]:
        """Return the residual's autocorrelation at lags 0 to `lags`, and the 99 % band for white noise."""
        return _correlation(self.residual, self.residual, lags)

    def cross_correlation(self, lags: int = 50) -> tuple[Float[np.ndarray, " lag"], float]:
        """Return the correlation of the residual with the input 0 to `lags` samples before, and its 99 % band.

        The band is that of independence, whatever the colours of both.

        Source: Bartlett, J. R. Statist. Soc. Suppl. 8 (1946); Ljung, System Identification (1999), section 16.6.
        """
        found, _ = _correlation(self.residual, self.current, lags)
        return found, _independence_band(self.residual, self.current)

    @property
    def whiteness_p(self) -> float:
        """Probability that white noise is at least as correlated over 25 lags (Ljung and Box, Biometrika 65, 1978)."""
        lags = int(min(25, np.sum(np.isfinite(self.residual)) // 4))
        if lags < 1:
            return 1.0
        correlation, _ = self.autocorrelation(lags)
        count = int(np.sum(np.isfinite(self.residual)))
        statistic = count * (count + 2) * np.sum(correlation[1:] ** 2 / (count - np.arange(1, lags + 1)))
        return float(chi2.sf(statistic, lags))


def _correlation(a: Values, b: Values, lags: int) -> tuple[np.ndarray, float]:
    """Return the cross-correlation, and the 99 % band if one of the two is white."""
    x, z = _centred(a), _centred(b)
    lags = min(lags, len(x) - 1)
    size = np.sqrt(np.sum(x**2) * np.sum(z**2))
    found = np.array([np.sum(x[k:] * z[: len(z) - k]) for k in range(lags + 1)])
    return found / size if size > 0 else 0 * found, float(norm.ppf(0.995) / np.sqrt(max(np.isfinite(a).sum(), 1)))


def _independence_band(a: Values, b: Values) -> float:
    """Return the 99 % band of the cross-correlation of independent signals.

    Its variance is sum_k R_a(k) R_b(k) / N.
    """
    own = _autocorrelation(_centred(a)) * _autocorrelation(_centred(b))
    # Over all lags the sum would be the mean square of the correlations themselves, and nothing could stand out of it;
    # and Parzen's window keeps it positive, which a cut would not.
    longest = max(len(own) // 3, 1)
    weight = parzen(2 * longest - 1)[longest - 1 :]
    inflation = own[0] + 2 * float(np.sum((weight * own[:longest])[1:]))
    return float(norm.ppf(0.995) * np.sqrt(inflation / len(own)))


def _autocorrelation(x: Values) -> Float[np.ndarray, " lag"]:
    """Return the autocorrelation at all lags; one at lag zero also where there is no signal."""
    length = next_fast_len(2 * len(x))
    found = np.fft.irfft(np.abs(np.fft.rfft(x, length)) ** 2, length)[: len(x)]
    return found / found[0] if found[0] > 0 else np.eye(1, len(x))[0]


def _centred(a: Values) -> Values:
    """Return the signal without its mean, and zero where nothing was measured."""
    return np.nan_to_num(a - np.nanmean(a)) if np.isfinite(a).any() else np.zeros_like(a)


@dataclasses.dataclass(frozen=True)
class ChannelError:
    """The error of one channel over several experiments."""

    fit_percent: float
    rms: float
    rms_over_noise: float


@dataclasses.dataclass(frozen=True)
class Compared:
    """The simulations of one model against the measurements.

    Attributes:
        label: for pictures and tables.
        model: the model.
        traces: one for every channel of every experiment.
        start: states at the start that were used, by experiment.
        beyond: experiments in which a learned force of the model is asked beyond its range; the variable, and at which fraction
            of the samples.
    """

    label: str
    model: RTAC
    traces: tuple[Trace, ...]
    start: Mapping[str, Float[np.ndarray, " state"]]
    beyond: Mapping[str, tuple[str, float]]

    @property
    def errors(self) -> dict[str, ChannelError]:
        """Errors per channel over all experiments."""
        found = {}
        for channel in CHANNELS:
            traces = [t for t in self.traces if t.channel == channel]
            if not traces:
                continue
            residual = np.concatenate([t.residual for t in traces])
            spread = np.concatenate([np.where(t.used, t.measured - np.nanmean(t.measured), np.nan) for t in traces])
            rms = float(np.sqrt(np.nanmean(residual**2)))
            whole = float(np.sqrt(np.nanmean(spread**2)))
            percent = 100 * (1 - rms / whole) if whole > 0 else float("-inf")
            found[channel] = ChannelError(percent, rms, rms / traces[0].noise)
        return found

    def worst(self, count: int = 3) -> list[Trace]:
        """Return the traces with the largest error in units of their noise."""
        return sorted(self.traces, key=lambda t: -t.rms / t.noise)[:count]


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison(Result):
    """The result of `compare`: one or several models against the same measurements."""

    models: tuple[Compared, ...]

    def overview(self) -> Overview:
        """Return the error of every model in every channel."""
        rows = [
            (compared.label, channel, f"{e.fit_percent:.2f}", f"{e.rms:.4g}", f"{e.rms_over_noise:.2f}")
            for compared in self.models
            for channel, e in compared.errors.items()
        ]
        experiments = {trace.experiment for compared in self.models for trace in compared.traces}
        title = f"{', '.join(m.label for m in self.models)} against {len(experiments)} experiments"
        return Overview(title, ("model", "channel", "fit [%]", "rms [SI]", "rms over noise"), rows)

    def __str__(self) -> str:
        lines = [
            f"{'model':18s} {'experiment':16s} {'channel':14s} {'fit':>8s} {'rms':>10s} {'rms/noise':>10s}  residual"
        ]
        for compared in self.models:
            for t in compared.traces:
                white = "white" if t.whiteness_p > 0.01 else "not white"
                lines.append(
                    f"{compared.label:18s} {t.experiment:16s} {t.channel:14s} {t.fit_percent:7.2f}% {t.rms:10.4g} "
                    f"{t.rms / t.noise:10.2f}  {white}"
                )
            for channel, error in compared.errors.items():
                lines.append(
                    f"{compared.label:18s} {'all':16s} {channel:14s} {error.fit_percent:7.2f}% {error.rms:10.4g} "
                    f"{error.rms_over_noise:10.2f}"
                )
            for experiment, (variable, share) in compared.beyond.items():
                lines.append(
                    f"{compared.label}: at {100 * share:.0f} % of {experiment} {variable} lies beyond the range of the learned "
                    "force, which keeps its last value there. One that is learned from such motion may follow it further."
                )
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw measured against model, as a matplotlib figure."""
        return draw(self)


def compare(
    fits: Fit | RTAC | Sequence[Fit | RTAC],
    recording: Recording,
    *,
    labels: Sequence[str] | None = None,
    start_samples: int | None = None,
) -> Comparison:
    """Simulate models freely and hold them against a recording.

    The states at the start, and parameters that each experiment has for itself, are fitted to the experiment; everything
    else is the model's.

    Args:
        fits: one or several fits or models.
        recording: that is simulated; those experiments that move count.
        labels: one for each of them.
        start_samples: use only so many samples to set the start, and leave them out of the error; by default the whole
            experiment sets its start, or its beginning where it is very long and the arm cannot wander.

    Raises:
        ValueError: nothing moves in the recording, or the labels do not fit.
        DivergedError: a model leaves all bounds in an experiment; the message names both.
    """
    require_configured()
    several = [fits] if isinstance(fits, Fit | RTAC) else list(fits)
    names = list(labels) if labels is not None else ["model"] if len(several) == 1 else _default_labels(several)
    if len(names) != len(several):
        raise ValueError(f"{len(several)} models need as many labels, not {len(names)}.")
    experiments = moving(recording)
    levels = noise_levels(recording.experiments)
    fitted = next((fit for fit in several if isinstance(fit, Fit)), None)
    if fitted is not None and not any(e.kind == "rest" for e in recording.experiments):
        levels |= {c: s for c, s in fitted.noise.items() if c in levels}
    return Comparison(
        tuple(
            _compare_one(fit, label, experiments, levels, start_samples)
            for fit, label in zip(several, names, strict=True)
        )
    )


def _default_labels(fits: Sequence[Fit | RTAC]) -> list[str]:
    models = [fit.model if isinstance(fit, Fit) else fit for fit in fits]
    common = set.intersection(*(set(m.ids) for m in models))
    return [("+ " + ", ".join(i for i in m.ids if i not in common)) if set(m.ids) - common else "base" for m in models]


def _compare_one(
    fit: Fit | RTAC,
    label: str,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    start_samples: int | None,
) -> Compared:
    model = fit.model if isinstance(fit, Fit) else fit
    known = None
    if isinstance(fit, Fit):
        same = [e.name for e in experiments if fit.marks.get(e.name) == mark_of(e)]
        known = {name: fit.start[name] for name in same}
    each = {n: jnp.mean(model[n]) for n in model.per_experiment}
    model = model.with_values(each)
    # Padding short experiments to the length of a very long one would cost more than going one by one.
    apart = any(e.samples > _LONG for e in experiments)
    groups = [[e] for e in experiments] if apart else [list(experiments)]
    traces: list[Trace] = []
    starts: dict[str, np.ndarray] = {}
    far: dict[str, tuple[str, float]] = {}
    for group in groups:
        simulated, start, used = _simulated(model, label, group, levels, known, start_samples, _substeps(fit))
        starts |= start
        for column, e in enumerate(group):
            shown = {c: simulated[: e.samples, row, column] for row, c in enumerate(CHANNELS) if c in e.outputs}
            if (found := beyond(model, e, shown)) is not None:
                far[e.name] = found
            drive = e.inputs.get("current") or e.inputs.get("disturbance_force")
            for channel, values in shown.items():
                traces.append(
                    Trace(
                        e.name,
                        channel,
                        np.asarray(e.time),
                        np.asarray(e.outputs[channel].values),
                        values,
                        np.zeros(e.samples) if drive is None else np.asarray(drive.values),
                        np.arange(e.samples) >= used,
                        levels[channel],
                    )
                )
    return Compared(label, model, tuple(traces), starts, far)


def _substeps(fit: Fit | RTAC) -> int | None:
    return int(fit.statistics["substeps"]) if isinstance(fit, Fit) else None


def _simulated(
    model: RTAC,
    label: str,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    known: Mapping[str, np.ndarray] | None,
    start_samples: int | None,
    substeps: int | None,
) -> tuple[np.ndarray, dict[str, np.ndarray], int]:
    """Return the outputs with the best start, the starts, and the sample from which on the error counts."""
    space = space_of(model, experiments, free=[], start=known)
    unknowns = space.unconstrained()
    noise = np.array([levels.get(channel, 1.0) for channel in CHANNELS])
    window = start_samples
    longest = max(e.samples for e in experiments)
    if window is None and longest > _LONG and all(e.arm == "locked" or "arm_angle" in e.outputs for e in experiments):
        window = _BEGINNING
    beginning = list(experiments)
    if window is not None:
        beginning = [e.cut(0, min(window, e.samples), e.name) for e in experiments]
    data = Data.of(beginning)
    steps = substeps or accurate_substeps(model, data, space, unknowns, noise)
    # A gain of zeros, as in a fit, so that both run the same compiled function.
    arguments = Arguments(model, data, space, diagonal_whitener(noise, data), no_gain(model, data), steps)
    fitted = known is not None and start_samples is None and all(e.name in known for e in experiments)
    fitted = fitted and not model.per_experiment
    everything = data if beginning == list(experiments) else Data.of(experiments)
    whole = dataclasses.replace(
        arguments,
        data=everything,
        whitener=diagonal_whitener(np.ones(3), everything),
        gain=no_gain(model, everything),
    )
    if not fitted:
        found = _started(unknowns, arguments)
        if found is None:
            _outputs(unknowns, whole, label, experiments)  # says where
            raise DivergedError(f"the model {label!r} diverges from every start that was tried; check its parameters.")
        unknowns = found
    simulated = _outputs(unknowns, whole, label, experiments)
    missing = np.asarray(everything.present) == 0
    if missing.any():
        simulated = np.where(missing, np.nan, simulated)
    states = np.asarray(space.physical(unknowns)[2])
    return simulated, {e.name: states[:, i] for i, e in enumerate(experiments)}, start_samples or 0


def _started(unknowns: Unknowns, arguments: Arguments) -> Unknowns | None:
    """Return the start from which the simulation follows the measurements best; None where it diverges from every one.

    It is sought from the first samples. Where that leaves more than noise of an experiment, and something may swing beside cart
    and arm, it is sought from rest too: a state that the first samples do not show, as the speed of an arm behind a soft shaft,
    adds up to turns of the arm, from where no small step leads back.
    """
    enough = _NOISE * np.asarray(arguments.data.present).sum(axis=(0, 1))
    begins = [unknowns, at_rest(unknowns, arguments.space)]
    best: Unknowns | None = None
    for begin in begins if may_swing(arguments.model) else begins[:1]:
        with contextlib.suppress(FloatingPointError):
            found = solve_bounded(begin, arguments, tolerance=1e-5, most=40).unknowns
            best = found if best is None else best_starts([best, found], arguments)
            if np.all(squares(best, arguments) < enough):
                break
    return best


def _outputs(unknowns: Unknowns, arguments: Arguments, label: str, experiments: Sequence[Experiment]) -> np.ndarray:
    """Return the model's outputs in these experiments.

    Raises:
        DivergedError: it leaves all bounds in one of them.
    """
    error, _ = plain_residual(unknowns, arguments)
    simulated = np.asarray(arguments.data.values) - np.asarray(error)
    # A comparison with NaN is false, so NaN counts as lost too.
    lost = (np.asarray(arguments.data.present) > 0) & ~(np.abs(simulated) < _LOST)
    for column, experiment in enumerate(experiments):
        if lost[..., column].any():
            instant = experiment.sample_time * float(np.argmax(lost[..., column].any(axis=1)))
            raise DivergedError(
                f"experiment {experiment.name}: the model {label!r} diverges {instant:.3g} s after the start and cannot be "
                "compared; fit it to this rig again (est.output_error), or check the sign and unit of the parameter last "
                "changed."
            )
    return simulated
