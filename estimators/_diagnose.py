"""Which physical effect is missing: candidates ranked on the innovations of a predictor, refitted, and judged."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2
from tqdm import tqdm

from estimators._covariance import information
from estimators._levenberg_marquardt import Arguments, factor
from estimators._likelihood import NoiseModel, Predictor, fit_predictor
from estimators._noise import noise_levels
from estimators._output_error import Fit, Parameter, moving, pieces
from estimators._problem import CHANNELS, Data, Space
from estimators._screen import ALARM, ForceCurve, Innovations, Screened, force_curves, orthonormal, screen
from estimators._start import scales_of, space_of
from rtac_jax import RTAC, require_configured
from rtac_jax._parameter import declarations
from rtac_jax._simulate import Steps
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.measurement import Experiment, Recording

Verdict = Literal["adequate", "missing", "ambiguous", "unknown"]

_REFITS = 4  # candidates refitted at least
_CLOSE = 0.3  # and those whose score is within this share of the best
_BIC_GAIN = 10.0  # what a candidate must gain, and within which it cannot be told from the best
_ROBUST = 9.0  # least chi-square with the scatter of the data in place of the model's variance
_EXPLAINED = 0.5  # share of what can be explained at all that an effect must explain to be named
_NUISANCE = 3  # free parameters that a candidate may have
_ROOM = 8  # unknowns are padded to a multiple of this, so that a model with one effect more needs no new compilation


@dataclasses.dataclass(frozen=True)
class Candidate:
    """What the data say of one effect of the catalogue.

    Attributes:
        id: of the effect.
        score: chi-square gained on the innovations of the base model, less the price of its amplitudes.
        p_value: probability of so large a score by chance among all that were tried.
        detection_limit: amplitude that would be found, in the unit of its first amplitude parameter.
        unit: of it.
        testable: whether the data could show the effect at a plausible size.
        refitted: whether it was fitted together with the base model.
        bic_gain: by that; positive speaks for the effect.
        error_reduction: share of the misfit that it removes.
        parameters: of the effect after refitting.
        correlation: of its template with those of the others, by id.
    """

    id: str
    score: float
    p_value: float
    detection_limit: float
    unit: str
    testable: bool
    refitted: bool = False
    bic_gain: float = 0.0
    error_reduction: float = 0.0
    parameters: Mapping[str, Parameter] = dataclasses.field(default_factory=dict)
    correlation: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    Attributes:
        verdict: "adequate", "missing", "ambiguous" or "unknown".
        effects: the accepted candidates, best first; for "ambiguous" the group that the data cannot tell apart.
        best: the best accepted effect with its estimated parameters, to be added to the model; None if there is none.
        candidates: all, best first.
        curves: missing force at each port against each variable, best first.
        where: mean squared innovation, one where the model is right, by experiment and channel.
        random_force, random_torque: what the predictor of the base model needs, as shares of the rms forces.
        explanation: in plain words.
        seconds: how long it took.
    """

    verdict: Verdict
    effects: tuple[Candidate, ...]
    best: Effect | None
    candidates: tuple[Candidate, ...]
    curves: tuple[ForceCurve, ...]
    where: Mapping[tuple[str, str], float]
    random_force: float
    random_torque: float
    explanation: str
    seconds: float

    def __str__(self) -> str:
        lines = [self.explanation, ""]
        lines.append(f"{'candidate':22s} {'score':>10s} {'p':>9s} {'BIC gain':>10s} {'removes':>8s}  detection limit")
        for c in self.candidates:
            gain = f"{c.bic_gain:10.1f}" if c.refitted else " " * 10
            removes = f"{100 * c.error_reduction:7.0f}%" if c.refitted else " " * 8
            limit = f"{c.detection_limit:.2g} {c.unit}" if c.testable else "not testable"
            lines.append(f"{c.id:22s} {c.score:10.1f} {c.p_value:9.2g} {gain} {removes}  {limit}")
        return "\n".join(lines)

    def plot(self) -> Any:
        """Bar chart of the candidates and the missing-force curve, as a matplotlib figure."""
        from estimators.plots import plot_diagnosis

        return plot_diagnosis(self)


def diagnose(
    fit: Fit,
    recording: Recording,
    *,
    candidates: Sequence[type[Effect]] | None = None,
    progress: bool = True,
) -> Diagnosis:
    """Say which effect the model of a fit leaves out, or that none is, or that the data cannot say.

    Args:
        fit: of the base model to this recording.
        candidates: classes of effects to try; by default the whole catalogue. Those of the model are passed over.
        progress: show a bar.

    Raises:
        ValueError: nothing moves in the recording, or no candidate is left.
        RuntimeError: JAX was not configured for double precision.

    Source: the steps of Kristensen, Madsen and Jorgensen (2004) for the predictor; score tests as in Basseville and
    Nikiforov, Detection of Abrupt Changes (1993), section 7.
    """
    require_configured()
    began = time.perf_counter()
    classes = [c for c in (candidates or CATALOGUE.values()) if c.id not in fit.model]
    if not classes:
        raise ValueError("no candidate is left: the model has every effect that was offered.")
    with tqdm(total=None, disable=not progress, desc="diagnose", unit=" steps", leave=False) as bar:
        work = _Work.of(fit, recording, classes, bar)
        return work.run(began)


@dataclasses.dataclass(frozen=True)
class _Refit:
    bic_gain: float
    predictor: Predictor
    space: Space


@dataclasses.dataclass
class _Work:
    """What stays the same over one diagnosis: the model with all candidates at null, and the data."""

    fit: Fit
    model: RTAC
    experiments: list[Experiment]
    data: Data
    prior: NoiseModel
    classes: list[type[Effect]]
    instances: list[Effect]
    substeps: Steps
    bar: Any

    @classmethod
    def of(cls, fit: Fit, recording: Recording, classes: list[type[Effect]], bar: Any) -> "_Work":
        experiments = pieces(moving(recording))
        scales = scales_of(fit.model, experiments)
        possible, instances = [], []
        for c in classes:
            found = c.candidates(scales)
            if found and _can_show(c, experiments):
                possible.append(c)
                instances += list(found)
        absent = {c.id: (found := c.candidates(scales)) and _absent_like(found[len(found) // 2]) for c in possible}
        model = _with_all(fit.model, absent)
        levels = dict(noise_levels(recording.experiments))
        space = space_of(model, experiments, free=_shared(fit.model), start=fit.start)
        prior = NoiseModel.of(levels, recording.experiments, scales, space)
        return cls(
            fit, model, experiments, Data.of(experiments), prior, possible, instances,
            jnp.asarray(fit.statistics["substeps"]), bar,
        )  # fmt: skip

    def space(self, model: RTAC, free: Sequence[str]) -> Space:
        """The unknowns, padded to one number for all candidates so that they share compiled functions."""
        found = space_of(model, self.experiments, free=free, start=self.fit.start)
        most = -(-(len(_shared(self.fit.model)) + _NUISANCE) // _ROOM) * _ROOM
        padded = np.full(most, len(found.names))
        padded[: len(found.active)] = np.asarray(found.active)[:most]
        return dataclasses.replace(found, active=jnp.asarray(padded))

    def predictor(self, space: Space, first: np.ndarray | None = None) -> Predictor:
        def show(text: str) -> None:
            self.bar.update(1)
            self.bar.set_postfix_str(text, refresh=False)

        return fit_predictor(
            self.model, self.data, space, self.prior, substeps=self.substeps, first=first, progress=show
        )

    def run(self, began: float) -> Diagnosis:
        base_free = _shared(self.fit.model)
        self.bar.set_description("diagnose: predictor of the base model")
        space = self.space(self.model, base_free)
        base = self.predictor(space)
        self.bar.set_description("diagnose: candidates")
        screened, curves = self._screen(space, base)
        best_by_id: dict[str, Screened] = {}
        for one in screened:
            if one.id not in best_by_id or one.statistic > best_by_id[one.id].statistic:
                best_by_id[one.id] = one
        tried = len(screened)
        ranked = sorted(best_by_id.values(), key=lambda s: -self._score(s))
        alarms = [s for s in ranked if s.statistic >= ALARM and s.robust >= _ROBUST and self._p(s, tried) < 0.01]
        top = self._score(ranked[0]) if ranked else 0.0
        chosen = [s for i, s in enumerate(alarms) if i < _REFITS or self._score(s) > (1 - _CLOSE) * top]
        refits: dict[str, _Refit] = {}
        for s in chosen:
            self.bar.set_description(f"diagnose: refit with {s.id}")
            refits[s.id] = self._refit(s, base)
        found = [self._candidate(s, tried, refits, base, ranked, curves) for s in ranked]
        found.sort(key=lambda c: (-c.bic_gain if c.refitted else 0.0, -c.score))
        verdict, effects = self._judge(found, curves)
        best = None
        if effects:
            best = self._effect(effects[0].id, refits[effects[0].id])
        where = self._where(base)
        return Diagnosis(
            verdict, tuple(effects), best, tuple(found), tuple(curves), where, base.random_force, base.random_torque,
            _words(verdict, effects, found, curves, where, base), time.perf_counter() - began,
        )  # fmt: skip

    # -- steps -------------------------------------------------------------------------------------------------------

    def _screen(self, space: Space, base: Predictor) -> tuple[list[Screened], list[ForceCurve]]:
        placed = dataclasses.replace(space, values=base.physical[0])
        innovations = Innovations(
            self.model, self.data, placed, base.filtered.whitener, base.filtered.gain, self.substeps
        )
        error = innovations.at(np.asarray(placed.values)[None])[:, 0]
        basis = orthonormal(innovations.jacobian())
        error = error - basis @ (basis.T @ error)

        def place(instance: Effect, amplitude: str) -> np.ndarray:
            values = np.asarray(placed.values).copy()
            for name, declared in declarations(instance).items():
                full = f"{instance.id}.{name}"
                if declared.null is None or name == amplitude:
                    values[placed.names.index(full)] = float(np.asarray(getattr(instance, name)))
            return values

        screened = screen(innovations, error, basis, self.instances, place)
        # The absent candidates do nothing; without them the probes compile and run faster.
        bare = space_of(self.fit.model, self.experiments, free=[], start=self.fit.start)
        known = dict(zip(placed.names, np.asarray(placed.values), strict=True))
        bare = dataclasses.replace(
            bare,
            values=jnp.asarray([known[name] for name in bare.names]),
        )
        rows = [list(self.model.states).index(name) for name in self.fit.model.states]
        gain = base.filtered.gain[:, jnp.asarray(rows)]
        probed = Innovations(self.fit.model, self.data, bare, base.filtered.whitener, gain, self.substeps)
        curves = force_curves(probed, error, basis, self._ranges())
        return screened, curves

    def _ranges(self) -> dict[str, tuple[float, float]]:
        def between(values: list[np.ndarray]) -> tuple[float, float]:
            if not values:
                return 0.0, 0.0
            low, high = np.nanquantile(np.concatenate(values), [0.001, 0.999])
            return float(low), float(high)

        def outputs(channel: str) -> list[np.ndarray]:
            return [e.outputs[channel].values for e in self.experiments if channel in e.outputs]

        scales = scales_of(self.fit.model, self.experiments)
        reach = 2.5 * scales.velocity if outputs("cart_position") else 0.0
        arm = any(e.arm == "free" for e in self.experiments)
        return {
            "cart_position": between(outputs("cart_position")),
            "cart_velocity": (-reach, reach),
            "arm_angle": (-np.pi, np.pi) if arm else (0.0, 0.0),
            "arm_velocity": between(outputs("arm_velocity")) if arm else (0.0, 0.0),
            "current": between([e.inputs["current"].values for e in self.experiments if "current" in e.inputs]),
        }

    def _refit(self, s: Screened, base: Predictor) -> "_Refit":
        """The base model with one candidate, fitted together."""
        names = [n for n in declarations(s.instance) if not declarations(s.instance)[n].fixed]
        values = dict(zip(self.space(self.model, []).names, np.asarray(base.physical[0]), strict=True))
        for name in declarations(s.instance):
            start = float(np.asarray(getattr(s.instance, name)))
            if name in s.amplitudes:
                estimate = float(s.estimate[s.amplitudes.index(name)])
                start = float(np.sign(estimate) * np.clip(abs(estimate), 0.05 * abs(start), 20 * abs(start)))
                start = start or 0.05 * float(np.asarray(getattr(s.instance, name)))
            values[f"{s.id}.{name}"] = start
        model = self.model.with_values({n: v for n, v in values.items() if n in self.model.parameters})
        free = _shared(self.fit.model) + [f"{s.id}.{n}" for n in names]
        space = self.space(model, free)
        found = self.predictor(space, base.noise)
        count = float(np.sum(np.asarray(self.data.present)))
        gain = 2 * (found.log_likelihood - base.log_likelihood) - len(names) * np.log(count)
        return _Refit(gain, found, space)

    def _score(self, s: Screened) -> float:
        count = float(np.sum(np.asarray(self.data.present)))
        return s.statistic - len(s.amplitudes) * np.log(count)

    def _p(self, s: Screened, tried: int) -> float:
        return float(min(1.0, tried * chi2.sf(s.statistic, len(s.amplitudes))))

    def _candidate(
        self,
        s: Screened,
        tried: int,
        refits: Mapping[str, _Refit],
        base: Predictor,
        ranked: Sequence[Screened],
        curves: Sequence[ForceCurve],
    ) -> Candidate:
        declared = declarations(s.instance)
        limit = float(np.min(s.limit))
        first = s.amplitudes[int(np.argmin(s.limit))]
        plausible = abs(float(np.asarray(getattr(s.instance, first))))
        common = {
            "id": s.id,
            "score": self._score(s),
            "p_value": self._p(s, tried),
            "detection_limit": limit,
            "unit": declared[first].unit,
            "testable": bool(np.isfinite(limit) and limit < 30 * plausible),
            "correlation": {o.id: _alike(s, o) for o in ranked if o.id != s.id},
        }
        if s.id not in refits:
            return Candidate(**common)
        refit = refits[s.id]
        gains = [r.predictor.log_likelihood - base.log_likelihood for r in refits.values()]
        possible = max([*gains, *(0.5 * c.explains for c in curves[:1])])
        own = refit.predictor.log_likelihood - base.log_likelihood
        return Candidate(
            **common,
            refitted=True,
            bic_gain=refit.bic_gain,
            error_reduction=float(np.clip(own / possible, 0.0, 1.0)) if possible > 0 else 0.0,
            parameters=self._parameters(s.id, refit.predictor, refit.space),
        )

    def _parameters(self, effect: str, found: Predictor, space: Space) -> dict[str, Parameter]:
        arguments = Arguments(self.model, self.data, space, found.filtered.whitener, found.filtered.gain, self.substeps)
        known = information(np.asarray(factor(found.unknowns, arguments)), space, found.unknowns)
        deviations = dict(zip(known.names, np.sqrt(np.diagonal(known.covariance)), strict=True))
        values = dict(zip(space.names, np.asarray(found.physical[0]), strict=True))
        return {
            name.split(".")[1]: Parameter(
                float(value), float(deviations.get(name, 0.0)), self.model.parameters[name].unit
            )
            for name, value in values.items()
            if name.split(".")[0] == effect
        }

    def _judge(self, found: Sequence[Candidate], curves: Sequence[ForceCurve]) -> tuple[Verdict, list[Candidate]]:
        good = [c for c in found if c.refitted and c.bic_gain > _BIC_GAIN]
        unexplained = bool(curves) and curves[0].score > ALARM
        if not good:
            return ("unknown" if unexplained else "adequate"), []
        best = good[0]
        if best.error_reduction < _EXPLAINED:
            return "unknown", []
        close = [c for c in good if best.bic_gain - c.bic_gain < _BIC_GAIN]
        return ("ambiguous" if len(close) > 1 else "missing"), close

    def _effect(self, effect: str, refit: "_Refit") -> Effect:
        values = dict(zip(refit.space.names, np.asarray(refit.predictor.physical[0]), strict=True))
        cls = next(c for c in self.classes if c.id == effect)
        return cls(**{name: values[f"{effect}.{name}"] for name in declarations(cls)})

    def _where(self, base: Predictor) -> dict[tuple[str, str], float]:
        squares = np.asarray(base.filtered.innovations) ** 2
        present = np.asarray(self.data.present)
        found = {}
        for column, experiment in enumerate(self.experiments):
            for row, channel in enumerate(CHANNELS):
                count = present[:, row, column].sum()
                if count:
                    found[experiment.name, channel] = float(squares[:, row, column].sum() / count)
        return found


def _with_all(model: RTAC, absent: Mapping[str, Effect]) -> RTAC:
    """The model with all candidates at null, in the order of the catalogue, whatever it has already.

    So every diagnosis of a loop runs the same compiled functions.
    """
    order = {name: place for place, name in enumerate(CATALOGUE)}
    effects = [*model.effects, *absent.values()]
    effects.sort(key=lambda effect: order.get(effect.id, len(order)))
    return RTAC(model.body, tuple(effects), model.fixed, model.per_experiment)


def _shared(model: RTAC) -> list[str]:
    return [name for name in model.free if name not in model.per_experiment]


def _absent_like(instance: Effect) -> Effect:
    """The effect at its null value with the shape of an instance."""
    shape = {
        name: float(np.asarray(getattr(instance, name)))
        for name, declared in declarations(instance).items()
        if declared.null is None
    }
    return type(instance).absent(**shape)


def _can_show(effect: type[Effect], experiments: Sequence[Experiment]) -> bool:
    """Whether what the effect acts on moves in any experiment."""
    arm = any(e.arm == "free" for e in experiments)
    cart = any(e.cart == "free" for e in experiments)
    driven = any("current" in e.inputs and np.any(e.inputs["current"].values) for e in experiments)
    if effect.port == "actuator":
        return driven and arm
    if effect.id.startswith(("arm_", "tacho_")) or effect.port == "arm":
        return arm
    if effect.port == "cart":
        return cart
    return True


def _alike(a: Screened, b: Screened) -> float:
    """Largest cosine between what two candidates would change."""
    qa, qb = orthonormal(a.templates), orthonormal(b.templates)
    if qa.shape[1] == 0 or qb.shape[1] == 0 or not (np.any(qa) and np.any(qb)):
        return 0.0
    return float(np.linalg.svd(qa.T @ qb, compute_uv=False)[0])


def _words(
    verdict: Verdict,
    effects: Sequence[Candidate],
    found: Sequence[Candidate],
    curves: Sequence[ForceCurve],
    where: Mapping[tuple[str, str], float],
    base: Predictor,
) -> str:
    (experiment, channel), worst = max(where.items(), key=lambda item: item[1])
    shown = (
        f"It shows most in {channel} of {experiment}, where the squared innovations are {worst:.2f} times the expected."
    )
    if verdict == "adequate":
        limits = sorted((c for c in found if c.testable), key=lambda c: c.id)
        text = ", ".join(f"{c.id} {c.detection_limit:.2g} {c.unit}" for c in limits)
        return f"Adequate: at the noise floor nothing is missing. An effect would have been found from: {text}."
    if verdict == "unknown":
        curve = curves[0] if curves else None
        near = next((c for c in found if c.refitted), None)
        what = f"The missing force acts on the {curve.port} and depends most on {curve.variable}." if curve else ""
        nearest = f" The nearest, {near.id}, explains {100 * near.error_reduction:.0f} %." if near else ""
        return f"Unknown: the model fails and no effect of the catalogue explains it.{nearest} {what} {shown}"
    best = effects[0]
    size = ", ".join(f"{n} = {p.value:.4g} +- {p.std:.2g} {p.unit}" for n, p in best.parameters.items())
    if verdict == "missing":
        return (
            f"Missing: {best.id} ({size}). Adding it gains {best.bic_gain:.0f} in BIC and explains "
            f"{100 * best.error_reduction:.0f} % of what any candidate or free force curve explains. {shown}"
        )
    group = ", ".join(c.id for c in effects)
    return f"Ambiguous: one of {group} is missing, and the data cannot say which; {best.id} fits best ({size}). {shown}"
