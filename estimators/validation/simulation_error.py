"""Simulation error: a model's free simulation against the measurements, per channel and experiment, and residual tests."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.data import CHANNELS, mark_of, moving
from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.core.information_criteria import InformationCriteria
from estimators.core.initial_state import without_angle
from estimators.core.result_base import Result
from estimators.core.sensor_noise import noise_levels, stated_levels
from estimators.prediction_error.fit import PredictorFit
from estimators.validation.extrapolation import beyond
from estimators.validation.free_simulation import HELD, LONG, Fitted, simulated_freely
from estimators.validation.prediction_ahead import ahead_of, known_from
from estimators.validation.trace import Trace
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.effect_contract import require_working_model
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.overview import Overview


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
        criteria: AIC, BIC and FPE of the fit, on what it was fitted to; None where no fit was given.
        diverging: experiments in which the model leaves all bounds, and after how long [s]; see `compare`.
    """

    label: str
    model: RTAC
    traces: tuple[Trace, ...]
    start: Mapping[str, Float[np.ndarray, " state"]]
    beyond: Mapping[str, tuple[str, float]]
    criteria: InformationCriteria | None = None
    diverging: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def errors(self) -> dict[str, ChannelError]:
        """Return the errors per channel over all experiments."""
        found = {}
        for channel in CHANNELS:
            traces = [t for t in self.traces if t.channel == channel]
            if not traces:
                continue
            residual = np.concatenate([t.residual for t in traces])
            spread = np.concatenate([t.deviation for t in traces])
            rms = float(np.sqrt(np.nanmean(residual**2)))
            whole = float(np.sqrt(np.nanmean(spread**2)))
            percent = 100 * (1 - rms / whole) if whole > 0 else float("-inf")
            white = np.concatenate([t.residual / t.noise for t in traces])
            found[channel] = ChannelError(percent, rms, float(np.sqrt(np.nanmean(white**2))))
        return found

    def worst(self, count: int = 3) -> list[Trace]:
        """Return the traces with the largest error in units of their noise."""
        return sorted(self.traces, key=lambda t: -t.rms / t.noise)[:count]


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison(Result):
    """The result of `compare`: one or several models against the same measurements.

    Attributes:
        models: each with its traces.
        ahead: samples by which the models predict; None for free simulations.
    """

    models: tuple[Compared, ...]
    ahead: int | None = None

    @property
    def several_ahead(self) -> str:
        """Say that errors of predictions several samples ahead are correlated, of a right model too; empty for others."""
        if self.ahead is None or self.ahead < 2:
            return ""
        return (
            f"Predictions {self.ahead} samples ahead: their errors are correlated even where the model is right, so whether "
            "they are white is not asked, and each holds the error of the state from which it was made."
        )

    @property
    def divergence(self) -> str:
        """Say which models leave all bounds in which experiments; empty where none does."""
        several = [(one.label, *where) for one in self.models for where in one.diverging.items()]
        said = ", ".join(f"{label} after {seconds:.3g} s of {name}" for label, name, seconds in several)
        much = f"its outputs are held there at {HELD:.0f} times the largest measured value"
        return f"A model diverges ({said}): {much}, so that others can be compared with it." if several else ""

    def with_noise(self, levels: Mapping[str, float]) -> "Comparison":
        """Return the same beside noise of some channels that is at least so large.

        Without a record at rest the noise is that of fast changes, and a sensor whose errors are slow has more.

        Args:
            levels: standard deviation by channel [its unit].
        """

        def louder(one: Compared) -> Compared:
            traces = (dataclasses.replace(t, noise=max(t.noise, levels.get(t.channel, 0.0))) for t in one.traces)
            return dataclasses.replace(one, traces=tuple(traces))

        return dataclasses.replace(self, models=tuple(map(louder, self.models))) if levels else self

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
        lines = [self.divergence] if self.divergence else []
        lines += [] if self.ahead is None else [self.several_ahead or "Predictions one sample ahead."]
        asked = not self.several_ahead
        lines += [
            f"{'model':18s} {'experiment':16s} {'channel':14s} {'fit':>8s} {'rms':>10s} {'rms/noise':>10s}"
            + "  residual" * asked
        ]
        for compared in self.models:
            for t in compared.traces:
                lines.append(
                    f"{compared.label:18s} {t.experiment:16s} {t.channel:14s} {t.fit_percent:7.2f}% {t.rms:10.4g} "
                    f"{t.rms / t.noise:10.2f}{f'  {t.colour}' * asked}"
                )
            for channel, error in compared.errors.items():
                lines.append(
                    f"{compared.label:18s} {'all':16s} {channel:14s} {error.fit_percent:7.2f}% {error.rms:10.4g} "
                    f"{error.rms_over_noise:10.2f}"
                )
            if compared.criteria is not None:
                lines.append(f"{compared.label}: {compared.criteria}, of the fit on what it was fitted to")
            for experiment, (variable, fraction) in compared.beyond.items():
                lines.append(
                    f"{compared.label}: at {100 * fraction:.0f} % of {experiment} {variable} lies beyond the range of the learned "
                    "force, which keeps its last value there. One that is learned from such motion may follow it further."
                )
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw measured against model, as a matplotlib figure."""
        return draw(self)


@checked_arguments
def compare(
    fits: Fitted | Sequence[Fitted],
    recording: Recording,
    *,
    labels: Sequence[str] | None = None,
    start_samples: int | None = None,
    ahead: int | None = None,
    hold_diverging: bool = False,
) -> Comparison:
    """Simulate models freely, or predict some samples ahead, and hold them against a recording.

    The states at the start, and parameters that each experiment has for itself, are fitted to the experiment; everything
    else is the model's. Predictions begin at the state to which a Kalman filter mends the model at each sample, with the
    random forces and the sensor noise of a `PredictorFit`, or, for other fits, those that make the recording likeliest.

    Args:
        fits: one or several fits or models.
        recording: that is simulated; those experiments that move count.
        labels: one for each of them.
        start_samples: use only so many samples to set the start, and leave them out of the error; by default the whole
            experiment sets its start, or its beginning where it is very long and the arm cannot wander.
        ahead: predict so many samples ahead instead; the first so many of an experiment do not count.
        hold_diverging: hold the outputs of a model that leaves all bounds in a free simulation at ten times the largest measured
            value, as of a first model that lacks something, in place of refusing it.

    Raises:
        ValueError: nothing moves in the recording, a model's value is no number, the labels do not fit, `ahead` is not positive,
            or it or `start_samples` leaves no sample of an experiment.
        DivergedError: a model leaves all bounds in an experiment, and is not held; the message names both.
    """
    require_configured()
    if ahead is not None and ahead < 1:
        raise ValueError(f"ahead: is {ahead}; give at least 1 sample, or None for a free simulation.")
    several = [fits] if isinstance(fits, Fit | PredictorFit | RTAC) else list(fits)
    if not several:
        raise ValueError("there is nothing to compare; give at least one fit or model.")
    names = list(labels) if labels is not None else ["model"] if len(several) == 1 else _default_labels(several)
    if len(names) != len(several):
        raise ValueError(f"{len(several)} models need as many labels, not {len(names)}.")
    if len(set(names)) < len(names):
        raise ValueError(f"labels are {', '.join(names)}: give each model one of its own.")
    for fit in several:
        require_working_model(fit if isinstance(fit, RTAC) else fit.model, batch=False)
    experiments = moving(recording)
    _require_samples(experiments, start_samples, ahead)
    levels = noise_levels(recording.experiments)
    fitted = next((fit for fit in several if isinstance(fit, Fit)), None)
    if fitted is not None and not any(e.kind == "rest" for e in recording.experiments):
        levels |= {c: s for c, s in fitted.noise.items() if c in levels}
    return Comparison(
        tuple(
            _compare_one(
                fit,
                label,
                experiments,
                levels,
                stated_levels(recording.experiments),
                start_samples,
                ahead,
                {} if hold_diverging else None,
            )
            for fit, label in zip(several, names, strict=True)
        ),
        ahead,
    )


def _default_labels(fits: Sequence[Fitted]) -> list[str]:
    models = [fit if isinstance(fit, RTAC) else fit.model for fit in fits]
    common = set.intersection(*(set(m.ids) for m in models))
    found = [("+ " + ", ".join(i for i in m.ids if i not in common)) if set(m.ids) - common else "base" for m in models]
    return [
        f"{name} ({found[: place + 1].count(name)})" if found.count(name) > 1 else name
        for place, name in enumerate(found)
    ]


def _require_samples(experiments: Sequence[Experiment], start_samples: int | None, ahead: int | None) -> None:
    """Refuse to leave out all samples of an experiment."""
    for name, count in (("ahead", ahead), ("start_samples", start_samples)):
        if count is None:
            continue
        if not isinstance(count, int | np.integer):
            raise ValueError(f"{name} is {count}; give a whole number of samples.")
        shortest = min(experiments, key=lambda e: e.samples)
        if count >= shortest.samples:
            raise ValueError(
                f"{name} is {count}: so many samples do not count, and {shortest.name} has {shortest.samples}; give fewer."
            )


def _compare_one(
    fit: Fitted,
    label: str,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    stated: Mapping[tuple[str, str], float],
    start_samples: int | None,
    ahead: int | None,
    lost: dict[str, float] | None,
) -> Compared:
    model = fit if isinstance(fit, RTAC) else fit.model
    known = None
    if isinstance(fit, Fit):
        same = [e.name for e in experiments if fit.marks.get(e.name) == mark_of(e)]
        known = {name: fit.start[name] for name in same}
    each = {n: jnp.mean(model[n]) for n in model.per_experiment}
    model = model.with_values(each)
    # Padding short experiments to the length of a very long one would cost more than going one by one.
    apart = any(e.samples > LONG for e in experiments)
    groups = [[e] for e in experiments] if apart else [list(experiments)]
    traces: list[Trace] = []
    starts: dict[str, np.ndarray] = {}
    far: dict[str, tuple[str, float]] = {}
    for group in groups:
        if ahead is None:
            simulated, start, used = simulated_freely(model, label, group, levels, known, start_samples, fit, lost)
        else:
            unmeasured = without_angle(group)
            begun = {e.name: known[e.name] for e in unmeasured if known is not None and e.name in known}
            if unknown := [e for e in unmeasured if e.name not in begun]:
                begun |= simulated_freely(model, label, unknown, levels, None, start_samples, fit, lost)[1]
            predictor = fit if isinstance(fit, PredictorFit) else None
            simulated, start = ahead_of(model, group, levels, ahead=ahead, fit=predictor, starts=begun)
            used = max(ahead, start_samples or 0)
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
                        np.arange(e.samples) >= used + (0 if ahead is None else known_from(e)),
                        stated.get((e.name, channel), levels[channel]),
                    )
                )
    criteria = None if isinstance(fit, RTAC) else fit.criteria
    return Compared(label, model, tuple(traces), starts, far, criteria, lost or {})
