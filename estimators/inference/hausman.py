"""Hausman's test of whether estimators of the same physics agree, and what a disagreement means."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import f as fisher
from scipy.stats import t as student
from tqdm import tqdm

from estimators.closed_form.table1 import CONSISTENT, ClosedForm
from estimators.core.data import CHANNELS
from estimators.core.drawing import draw
from estimators.core.fit import FAR, Fit
from estimators.core.initial_state import scales_of
from estimators.core.linearisation import at_fit
from estimators.core.piecewise_triangle import LONG
from estimators.inference.assumptions import ASSUMES
from estimators.inference.bootstrap import Shaken, Shuffled, Source
from estimators.inference.estimates import MODAL, Estimator, Result, estimator_of, label_of
from estimators.inference.shaken_simulation import shaken_by, signal_rms
from estimators.inference.simulation_residual import SimulationResidual, known_noise, simulation_residual
from estimators.linear.fit import LinearModels
from estimators.prediction_error.fit import PredictorFit
from rtac_jax import RTAC, require_configured
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Recording

Vector = Float[np.ndarray, " quantity"]
_BROKEN_BY = 4  # effects that are named with an assumption, the likeliest ones
_DRAWS, _FEW = 80, 32  # replicates, of experiments that are short or long
_DOUBTED = 0.05  # joint p-value, counted for all pairs, below which two estimates are not said to agree: the usual level of doubt
_HIDES = (
    " The random forces that the prediction error takes into account may stand for an effect that is missing; est.diagnose "
    "tells the two apart."
)


_ASK = " Add est.prediction_error_nonlinear's result, which estimates random forces, and ask est.diagnose."


@dataclasses.dataclass(frozen=True)
class Disagreement:
    """The difference between two estimators.

    Attributes:
        labels: of the two.
        difference: first less second, each after the step that the replicates take too, less what their own bias would make
            it were the model right; NaN for a quantity that one of them does not estimate.
        bias: that bias, taken off.
        std: of the difference, were the model right.
        p_values: per quantity.
        p_value: jointly.
    """

    labels: tuple[str, str]
    difference: Vector
    bias: Vector
    std: Vector
    p_values: Vector
    p_value: float


@dataclasses.dataclass(frozen=True)
class Agreement:
    """The result of `agreement`.

    Attributes:
        names: of the quantities that two estimators or more give: parameters, and natural frequency and damping ratio of
            the cart where a linear fit takes part.
        units: SI units.
        labels: of the estimators.
        asks: what the model must be right for so that this estimator is, in words.
        values: estimates [estimator quantity]; NaN where one does not give it.
        std: their standard deviations, were the model right [estimator quantity].
        pairs: every two estimators compared.
        level: at which a disagreement is called one.
        draws: replicates that the distribution of the differences was taken from.
        disturbed: whether the replicates hold random forces and torques.
        misfit: residual of each output error over the noise, of its worst channel, by label.
        simulation: what the residual of the first output error means where its noise is known; None without an output error.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    asks: tuple[str, ...]
    values: Float[np.ndarray, "estimator quantity"]
    std: Float[np.ndarray, "estimator quantity"]
    pairs: tuple[Disagreement, ...]
    level: float
    draws: int
    disturbed: bool
    misfit: Mapping[str, float]
    simulation: SimulationResidual | None = None

    @property
    def rejected(self) -> bool:
        """Return whether any two disagree by more than chance allows; the level is shared between the pairs."""
        return any(pair.p_value < self.level / len(self.pairs) for pair in self.pairs)

    @property
    def doubted(self) -> bool:
        """Return whether two differ by more than is usual, so that nothing is confirmed, be they rejected or not."""
        return self.worst.p_value * len(self.pairs) < max(_DOUBTED, self.level)

    @property
    def worst(self) -> Disagreement:
        """Return the two estimators that disagree most clearly."""
        return min(self.pairs, key=lambda pair: pair.p_value)

    @property
    def differing(self) -> tuple[str, ...]:
        """Quantities whose estimates differ, the clearest first; where they differ only jointly, the clearest one."""
        if not self.rejected:
            return ()
        smallest = np.min([np.nan_to_num(pair.p_values, nan=1.0) for pair in self.pairs], axis=0)
        order = np.argsort(smallest)
        bound = self.level / (len(self.names) * len(self.pairs))
        return tuple(self.names[i] for i in order if smallest[i] < bound) or (self.names[order[0]],)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Return the ids of effects that break the assumptions of these quantities, those of the clearest difference first.

        Where to look first, and no list to choose from: a fit of the whole motion hands an error on to other quantities too.
        """
        named = [effect for name in self.differing for effect in ASSUMES.get(name, ("", ()))[1]]
        return tuple(effect for effect in dict.fromkeys(named) if effect in CATALOGUE)

    @property
    def verdict(self) -> str:
        """Return the verdict in words: whether they agree, which assumption fails, and what to look at next."""
        smallest = self.worst.p_value
        if not self.rejected:
            chance = f"differences as large as these come about by chance (p = {smallest:.2g})."
            hides = _HIDES if "prediction error" in self.labels else ""
            words = self.simulation.words if self.simulation is not None else ""
            if self.simulation is not None and self.simulation.vetoes:
                return f"No two disagree: {chance} That confirms nothing. {words}{hides or _ASK}"
            if self.doubted:
                return f"{self._nearly()}{' ' * bool(words)}{words}{self._untold()}{hides}"
            holds = words or "What the estimates rest on holds as far as these data can tell."
            return f"They agree: {chance} {holds}{self._untold()}{hides}"
        failing = [
            f"that {words} (broken by {', '.join(effects[:_BROKEN_BY])})"
            for words, effects in dict.fromkeys(ASSUMES[n] for n in self.differing if n in ASSUMES)
        ]
        fails = f" Doubt first {', then '.join(failing[:3])}." if failing else ""
        first, second = (self.asks[self.labels.index(label)] for label in self.worst.labels)
        both = f"both for {first} and for {second}." if first != second else f"for {first}."
        return (
            f"They disagree (p = {smallest:.2g}), most clearly in {', '.join(self.differing[:3])}: one model cannot be right "
            + both
            + fails
            + " Ask est.diagnose, which holds these and all others against the data; est.compare shows where the model fails."
            + self._but()
        )

    def _nearly(self) -> str:
        """Say what differs by more than is usual, though by less than the level of the test asks."""
        worst, several = self.worst, len(self.pairs)
        clearest = self.names[int(np.nanargmin(worst.p_values))]
        among = (
            f", and with {several} pairs one as large in {100 * worst.p_value * several:.2g} %" if several > 1 else ""
        )
        return (
            f"No two disagree at the level of {100 * self.level:.2g} %, but {worst.labels[0]} and {worst.labels[1]} differ, most "
            f"clearly in {clearest}, as they would by chance in {100 * worst.p_value:.2g} % of such recordings{among}: that "
            "confirms nothing, and a longer recording decides it."
        )

    def _untold(self) -> str:
        """Name the constants that every rig has and that the estimates are too unsure of to confirm each other."""
        sizes = np.nanmin(np.abs(self.values), axis=0)
        known = np.nanmin([np.where(np.isfinite(p.std), p.std, np.inf) for p in self.pairs], axis=0)
        untold = [
            name
            for name, size, std in zip(self.names, sizes, known, strict=True)
            if "." not in name and np.isfinite(std) and std > CONSISTENT * size
        ]
        if not untold:
            return ""
        least = f"{100 * CONSISTENT:.0f} %"
        return f" That tells nothing of {', '.join(untold)}: a difference would have to be larger than {least} to show."

    def _but(self) -> str:
        """Say what else than the model could be wrong with a disagreement."""
        if not self.disturbed:
            return (
                " A random force or torque on the rig makes them disagree too: add est.prediction_error_nonlinear's result, "
                "which counts it."
            )
        far = [label for label in self.worst.labels if self.misfit.get(label, 0.0) > FAR]
        if not far:
            return ""
        return (
            f" But the residual of {far[0]} is {self.misfit[far[0]]:.0f} times the noise, and how far a disturbance leads it "
            "is known to first order only: hold the others against each other without it."
        )

    def __str__(self) -> str:
        wide = max(15, *(len(label) for label in self.labels))
        lines = [f"{'quantity':26s}" + "".join(f" {label:>{wide}s} {'std':>9s}" for label in self.labels) + "  unit"]
        for i, name in enumerate(self.names):
            cells = "".join(
                f" {v[i]:{wide}.6g} {s[i]:9.2g}" if np.isfinite(v[i]) else " " * (wide + 11)
                for v, s in zip(self.values, self.std, strict=True)
            )
            lines.append(f"{name:26s}{cells}  {self.units[i]}")
        for pair in self.pairs:
            lines.append(f"\n{pair.labels[0]} less {pair.labels[1]}")
            lines.append(
                f"{'quantity':26s} {'difference':>12s} {'of it bias':>12s} {'std':>10s} {'sigmas':>8s} {'p':>9s}"
            )
            for i, name in enumerate(self.names):
                if not np.isfinite(pair.difference[i]):
                    continue
                lines.append(
                    f"{name:26s} {pair.difference[i] + pair.bias[i]:12.3g} {pair.bias[i]:12.2g} {pair.std[i]:10.2g} "
                    f"{pair.difference[i] / pair.std[i]:8.1f} {pair.p_values[i]:9.2g}"
                )
            lines.append(f"{'all together':26s} {'':12s} {'':12s} {'':10s} {'':8s} {pair.p_value:9.2g}")
        return "\n".join([*lines, "", self.verdict])

    def plot(self) -> Any:
        """Draw the differences in standard deviations, as a matplotlib figure."""
        return draw(self)


def agreement(
    results: Sequence[Result],
    recording: Recording,
    *,
    labels: Sequence[str] | None = None,
    level: float = 0.01,
    draws: int | None = None,
    block: float = 0.25,
    seed: int = 0,
    progress: bool = True,
) -> Agreement:
    """Compare estimates of the same physics, made by different estimators from the same recording.

    Hausman's idea: two estimators that are both right when the model is right differ only by chance, so a difference that
    is large beside its own standard deviation shows that the model is wrong. Neither estimator need be efficient: the
    distribution of the difference comes from replicates, from each of which every estimator estimates anew (a fit by one
    Gauss-Newton step), so that their common errors cancel, and the bias that an estimator has on such data is taken off. That also
    lets a linear fit take part, whose natural frequency and damping are those of the cart with dry friction and arm; pairs
    with it, and the joint verdict over pairs that depend on each other, reject more rarely than the level says.

    Where `prediction_error_nonlinear` is among the results, a replicate is its model struck by random forces and torques as
    large as it estimated; else it is the first output error's simulation with its residual, in blocks and in random order, as
    the noise, or without an output error the first closed form's, whose starts alone are fitted. The first kind counts
    disturbances of the rig, and so what they hide; the second takes them for a failing.
    An output error that disturbances have led far astray, its residual many times the noise, is better left out.

    Args:
        results: of `least_squares`, `output_error`, `prediction_error_nonlinear` and `prediction_error`; at least one of the
            first three, and a closed form should be made with `weak=True`.
        recording: the one that all were made from.
        labels: of the results, each another.
        level: of the test.
        draws: replicates; more than three times as many as there are quantities. By default 80, or 32 where an experiment is
            long: p-values count that they are few, and a replicate takes seconds there.
        block: duration that stays together when the residual is put in another order [s]; longer than its correlation time.
        seed: of the replicates.
        progress: show a bar.

    Raises:
        ValueError: fewer than two results, no fit of the nonlinear model among them, nothing in common, too few draws, or
            labels that are too few or the same.
        RuntimeError: JAX was not configured for double precision.

    Source: Hausman, Econometrica 46 (1978); joint test: Hotelling's T^2; replicates: Kuensch, Ann. Statist. 17 (1989); a
    linear model of what is not linear: Gourieroux, Monfort and Renault, J. Appl. Econometrics 8 (1993), indirect inference.
    """
    require_configured()
    several = list(results)
    predictors = [r for r in several if isinstance(r, PredictorFit)]
    fits = [r for r in several if isinstance(r, Fit)]
    if len(several) < 2:
        raise ValueError("agreement holds estimates against each other; give two results or more.")
    if len({id(r) for r in several}) < len(several):
        raise ValueError("one result is given twice, and agrees with itself; give each once.")
    closed = [r for r in several if isinstance(r, ClosedForm)]
    if not fits and not predictors and not closed:
        raise ValueError(
            "agreement needs an estimate of the physics, whose simulation stands for the truth; add est.least_squares's (with "
            "weak=True), est.output_error's or est.prediction_error_nonlinear's result."
        )
    said = tuple(labels) if labels is not None else _labels(several)
    if len(said) != len(several) or len(set(said)) < len(said):
        raise ValueError(f"{len(several)} results need as many labels, each another, not {', '.join(said)}.")
    if predictors:
        source: Source = Shaken.of(predictors[0])
    elif fits:
        source = Shuffled.of(fits[0], recording, block=block)
    else:
        source = Shuffled.of_model(closed[0].model, recording, block=block)
    modal = any(isinstance(r, LinearModels) for r in several)
    for names in {tuple(r.experiments) for r in (*fits, *predictors)} - {
        tuple(one.experiments) for one in (*predictors, *fits)[:1]
    }:
        raise ValueError(
            f"the fits used different experiments, one of them {', '.join(names[:3])}; fit them to the same recording."
        )
    if fitted := [*predictors, *fits]:
        several = [_with_constants_of(fitted[0].model, result) for result in several]
    estimators = [
        estimator_of(result, label, source, recording, modal=modal) for result, label in zip(several, said, strict=True)
    ]
    shared = {
        (a, b): _common(estimators[a], estimators[b]) for a, b in itertools.combinations(range(len(estimators)), 2)
    }
    if not any(shared.values()):
        raise ValueError("the results have no estimated parameter in common.")
    widest = max(len(names) for names in shared.values())
    if draws is None:
        draws = _FEW if max(e.samples for e in recording) >= LONG else _DRAWS
    if draws <= 3 * widest:
        raise ValueError(f"draws is {draws}; {widest} quantities need more than {3 * widest}.")
    names = tuple(dict.fromkeys(n for common in shared.values() for n in common))
    units = tuple(next(w.units[w.names.index(n)] for w in estimators if n in w.names) for n in names)
    random = np.random.default_rng(seed)
    found = np.full((draws, len(estimators), len(names)), np.nan)
    for number in tqdm(range(draws), desc="agreement", unit=" replicates", disable=not progress, leave=False):
        measured = source.draw(random)
        for row, estimator in enumerate(estimators):
            found[number, row] = _in_order(estimator, estimator.again(measured), names)
    # The estimates by the same step as in the replicates: what an optimiser left undone is large beside the difference of
    # two estimators that almost agree.
    measured = source.measured
    observed = np.array([_in_order(estimator, estimator.again(measured), names) for estimator in estimators])
    values = np.array([_in_order(estimator, estimator.values, names) for estimator in estimators])
    pairs = tuple(
        _pair(
            (said[a], said[b]), observed[a] - observed[b], found[:, a] - found[:, b],
            np.array([n in common for n in names]),
        )
        for (a, b), common in shared.items()
        if common
    )  # fmt: skip
    spread = np.std(found, axis=0, ddof=1)
    asks = tuple(estimator.asks for estimator in estimators)
    misfit = {
        label: max(result.residual_std[c] / n for c, n in result.noise.items() if c in result.residual_std)
        for label, result in zip(said, several, strict=True)
        if isinstance(result, Fit)
    }
    simulation = _simulation(fits[0], recording, predictors) if fits else None
    return Agreement(
        names, units, said, asks, values, spread, pairs, level, draws, bool(predictors), misfit, simulation
    )


def _with_constants_of(model: RTAC, result: Result) -> Result:
    """Return a closed form about the constants that a fit has estimated.

    It holds them where they were measured, and so all that it estimates is off alike: no failing of the model.
    """
    if not isinstance(result, ClosedForm):
        return result
    values = {name: float(model[name]) for name in model.uncertain if name in result.model.parameters}
    return dataclasses.replace(result, model=result.model.with_values(values))


def _simulation(fit: Fit, recording: Recording, predictors: Sequence[PredictorFit]) -> SimulationResidual:
    """Return what the residual of an output error means, beside the random forces of a predictor if there is one."""
    problem = at_fit(fit, recording)
    data = problem.arguments.data
    rows = {c: CHANNELS.index(c) for c in fit.residual_std if c in known_noise(recording)}
    random, deviation = (float("nan"), float("nan")), {}
    if predictors:
        left, random = shaken_by(predictors[0], np.asarray(problem.arguments.space.physical(problem.unknowns)[2]))
        deviation = {c: float(left[row]) / fit.noise[c] for c, row in rows.items()}
    signal = signal_rms(data)
    scales = scales_of(fit.model, problem.experiments)
    return simulation_residual(
        {c: fit.residual_std[c] / fit.noise[c] for c in rows},
        deviation,
        {c: float(signal[row]) / fit.noise[c] for c, row in rows.items()},
        random=random,
        samples_per_radian=1.0 / (scales.frequency * scales.sample_time),
        experiments=len(problem.experiments),
    )


def _common(one: Estimator, other: Estimator) -> tuple[str, ...]:
    """Return what both estimate; between two of the physics its parameters, of which the modal quantities are functions."""
    skipped = MODAL if one.physical and other.physical else ()
    return tuple(n for n in one.names if n in other.names and n not in skipped)


def _in_order(estimator: Estimator, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    at = dict(zip(estimator.names, values, strict=True))
    return np.array([at.get(n, np.nan) for n in names])


def _pair(
    labels: tuple[str, str],
    observed: Vector,
    drawn: Float[np.ndarray, "draw quantity"],
    common: Bool[np.ndarray, " quantity"],
) -> Disagreement:
    kept = drawn[:, common]
    kept = kept[np.all(np.isfinite(kept), axis=1)]
    draws, width = kept.shape
    if draws <= 2 * width:
        raise ValueError(
            f"{labels[0]} or {labels[1]} came out in {draws} of {len(drawn)} replicates only; raise draws, or leave it out."
        )
    bias = np.mean(kept, axis=0)
    covariance = np.cov(kept, rowvar=False).reshape(width, width) * (1 + 1 / draws)
    std = np.sqrt(np.diagonal(covariance))
    difference = observed[common] - bias
    p_values = 2 * student.sf(np.abs(difference) / std, draws - 1)
    scaled = difference / std
    squared = float(scaled @ np.linalg.solve(covariance / np.outer(std, std), scaled))
    joint = float(fisher.sf(squared * (draws - width) / (width * (draws - 1)), width, draws - width))

    def whole(values: np.ndarray) -> np.ndarray:
        placed = np.full(len(common), np.nan)
        placed[common] = values
        return placed

    return Disagreement(labels, whole(difference), whole(bias), whole(std), whole(p_values), joint)


def _labels(results: Sequence[Result]) -> tuple[str, ...]:
    said = [label_of(r) for r in results]
    return tuple(s if said.count(s) == 1 else f"{s} {said[:i].count(s) + 1}" for i, s in enumerate(said))
