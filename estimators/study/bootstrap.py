"""Bootstrap of one fit: refit data as they might have come out too, and take intervals from the scatter."""

import dataclasses
import functools
import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from estimators.core.data import CHANNELS, fitted_part, mark_of, moving
from estimators.core.fit import ON_BOUND, Fit
from estimators.inference.bootstrap import Shaken, Shuffled, measured_again
from estimators.output_error.fit import output_error
from estimators.prediction_error.fit import PredictorFit, prediction_error_nonlinear
from estimators.reporting.html import Table
from estimators.study.layout import Arrays, Layout
from estimators.study.run import repeated
from estimators.study.toml_writer import toml
from estimators.study.work import Work
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording
from rtac_jax.prior import Prior

_PER_CHUNK = 25
_FORMAT = 2  # of what is drawn: raised when the same call would give other numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Bootstrap:
    """Result of `bootstrap`.

    Attributes:
        names, units: of the parameters.
        values: the estimates, SI units.
        stated: standard deviations that the fit states, by Cramer and Rao.
        samples: estimates from each replicate; NaN where the fit of it failed.
        reasons: why it failed; empty where it did not.
        method: how replicates were drawn.
        bounds: lowest and highest value that each parameter can have.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    stated: Float[np.ndarray, " parameter"]
    samples: Float[np.ndarray, "replicate parameter"]
    reasons: tuple[str, ...]
    method: str
    bounds: Float[np.ndarray, "parameter 2"]

    @property
    def std(self) -> dict[str, float]:
        """Return the standard deviation of each parameter over the replicates."""
        return dict(zip(self.names, (float(s) for s in np.std(self._kept, axis=0, ddof=1)), strict=True))

    @property
    def bias(self) -> dict[str, float]:
        """Mean over the replicates less the estimate that they were drawn around."""
        return dict(zip(self.names, (float(b) for b in np.mean(self._kept, axis=0) - self.values), strict=True))

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence interval of each parameter: the errors of the replicates, turned about the estimate.

        Where these end beyond a bound, as those of a friction level that may be nothing, errors are no longer alike about the
        estimate and about the truth: there, the interval holds the middle of the replicates themselves.

        Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), section 2.4: the basic interval; Efron and
        Tibshirani, An Introduction to the Bootstrap (1993), chapter 13: that of percentiles, which keeps to bounds.
        """
        percentiles = self._percentiles(level)
        basic = 2 * self.values - percentiles[::-1]
        # A fit comes as near to a bound as this, and not onto it.
        near = ON_BOUND * self.stated
        lowest, highest = self.bounds.T
        low = np.where(percentiles[0] - lowest < near, lowest, percentiles[0])
        high = np.where(highest - percentiles[1] < near, highest, percentiles[1])
        ends = np.where(self._reaches_beyond(basic), [low, high], basic)
        return {n: (float(a), float(b)) for n, (a, b) in zip(self.names, ends.T, strict=True)}

    @property
    def bounded(self) -> tuple[str, ...]:
        """Return the parameters whose 95 % interval is one of percentiles, because they may lie on a bound."""
        beyond = self._reaches_beyond(2 * self.values - self._percentiles(0.95)[::-1])
        return tuple(n for n, one in zip(self.names, beyond, strict=True) if one)

    def _percentiles(self, level: float) -> Float[np.ndarray, "end parameter"]:
        """Return the ends between which so many of the replicates lie."""
        return np.quantile(self._kept, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)

    def _reaches_beyond(self, ends: Float[np.ndarray, "end parameter"]) -> Bool[np.ndarray, " parameter"]:
        """Return which intervals end on a bound or beyond it."""
        return (ends[0] <= self.bounds[:, 0]) | (ends[1] >= self.bounds[:, 1])

    @property
    def _kept(self) -> Float[np.ndarray, "replicate parameter"]:
        return self.samples[np.all(np.isfinite(self.samples), axis=1)]

    def table(self) -> Table:
        """Estimates with the stated standard deviation, that of the bootstrap, and its interval."""
        std, bias, interval = self.std, self.bias, self.interval()
        rows = tuple(
            (name, f"{value:.6g}", f"{stated:.2g}", f"{std[name]:.2g}", f"{bias[name]:+.2g}",
             f"{interval[name][0]:.6g} to {interval[name][1]:.6g}", unit)
            for name, unit, value, stated in zip(self.names, self.units, self.values, self.stated, strict=True)
        )  # fmt: skip
        header = ("parameter", "value", "std stated", "std of bootstrap", "bias", "95 % interval", "unit")
        failed = sum(bool(reason) for reason in self.reasons)
        note = f"; {failed} could not be fitted" if failed else ""
        if self.bounded:
            note += f"; of {', '.join(self.bounded)}, which may lie on a bound, the interval is that of percentiles"
        return Table(header, rows, f"{len(self.samples)} replicates, {self.method}{note}.")

    def __str__(self) -> str:
        table = self.table()
        return f"{table}\n{table.caption}"


@checked_arguments
def bootstrap(
    fit: Fit | PredictorFit,
    recording: Recording,
    *,
    repetitions: int = 200,
    seed: int = 1,
    method: str = "parametric",
    block: float | int = 0.5,
    executor: Executor | str | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Bootstrap:
    """Refit replicates of a recording, whose scatter gives standard deviations and intervals beside those that the fit states.

    "parametric" repeats the fit's own assumptions: white noise of the residual's size on its simulation, or for
    `prediction_error_nonlinear` random forces and sensor noise of the estimated sizes. It shows what linearising hid. "blocks" puts
    stretches of the residual in another order, so that it holds where the residual is coloured, or what is missing in the model
    acts alike everywhere. Of runs that are few blocks long it is too narrow: a residual has lost what the fit could take from it
    (five runs of 3 s, blocks of half a second, white noise: 0.9 of the stated deviation, 0.68 at least; parametric 1.0).
    Constants that were measured with a standard deviation are measured again for each replicate.

    Args:
        fit: of `output_error` or `prediction_error_nonlinear`.
        recording: the one that was fitted; experiments that the fit did not use are left out.
        repetitions: replicates; 200 for standard deviations, 1,000 and more for intervals.
        seed: of the draws.
        method: "parametric" or "blocks".
        block: length of a stretch [s], several times as long as the residual remembers.
        executor: as for `study`.
        out: folder in which it goes on where it was ended; None keeps nothing.
        progress: show a bar.

    Raises:
        ValueError: the recording is not the one that was fitted, or the method does not go with the fit.
        RuntimeError: JAX was not configured for double precision.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapters 6 and 8; Kunsch, Annals of Statistics 17 (1989).
    """
    require_configured()
    if method not in ("parametric", "blocks"):
        raise ValueError(f"method is {method!r}; use 'parametric' or 'blocks'.")
    if method == "blocks" and isinstance(fit, PredictorFit):
        raise ValueError(
            "method='blocks' puts simulation errors in another order; a fit by predictions takes 'parametric'."
        )
    if repetitions < 2:
        raise ValueError(f"repetitions is {repetitions}; give at least 2.")
    if not block > 0:
        raise ValueError(f"block is {block}; give a length in seconds.")
    shortest = min(e.duration for e in moving(fitted_part(recording, fit.experiments)))
    if method == "blocks" and not block <= 0.5 * shortest:
        raise ValueError(
            f"block is {block} s, and the shortest experiment takes {shortest:.3g} s; give half of that at most."
        )
    work = Replicates(fit, fitted_part(recording, fit.experiments), repetitions, seed, method, float(block))
    _ = work.source  # refuses another recording before anything is kept
    _, arrays = repeated(work, work.description, executor=executor, out=out, chunk=None, progress=progress)
    names = fit.information.names
    return Bootstrap(
        names,
        tuple(fit.parameters[name].unit for name in names),
        np.array([fit.parameters[name].value for name in names]),
        np.array([fit.parameters[name].std for name in names]),
        arrays["estimate"],
        tuple(str(reason) for reason in arrays["reason"]),
        method,
        np.array([fit.model.parameters[name].bounds for name in names]),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Replicates(Work):
    """The work of a bootstrap."""

    fit: Fit | PredictorFit
    recording: Recording
    repetitions: int
    seed: int
    method: str
    block: float

    @property
    def name(self) -> str:
        """Return what a bar of progress shows."""
        return "bootstrap"

    @property
    def count(self) -> int:
        """Return how many there are."""
        return self.repetitions

    @property
    def per_chunk(self) -> int:
        """Return how many one chunk has by default."""
        return _PER_CHUNK

    @property
    def layout(self) -> Layout:
        """Return what a replicate keeps."""
        return Layout({"estimate": ("parameter",)}, {"reason": ()}, {"parameter": self.fit.information.names})

    @property
    def digest(self) -> str:
        """Hash of the fit, the measurements, and how replicates are drawn."""
        values = [f"{name} {found.value!r} {found.std!r}" for name, found in self.fit.parameters.items()]
        marks = [f"{e.name} {mark_of(e)}" for e in self.recording.experiments]
        text = "\n".join([str(_FORMAT), *values, *marks, f"{self.seed} {self.method} {self.block!r}"])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def description(self) -> str:
        """Return the description as TOML."""
        return toml(
            {
                "bootstrap": {
                    "repetitions": self.repetitions,
                    "seed": self.seed,
                    "method": self.method,
                    "digest": self.digest,
                }
            }
        )

    @functools.cached_property
    def source(self) -> Shuffled | Shaken:
        """Return what replicates are drawn from.

        Raises:
            ValueError: the recording is not the one that was fitted.
        """
        if isinstance(self.fit, PredictorFit):
            return Shaken.of(self.fit)
        found = Shuffled.of(self.fit, self.recording, block=self.block)
        return dataclasses.replace(found, error=found.measured - found.simulated)  # as large as it is

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def compute(self, indices: Sequence[int]) -> Arrays:
        """Draw and refit the replicates with these numbers."""
        kept = self.layout.empty(len(indices))
        for row, index in enumerate(indices):
            random = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(index,)))
            try:
                drawn = self._drawn(random)
                kept["estimate"][row] = self._refitted(drawn, self._weighed_again(random))
            except (ValueError, ArithmeticError) as error:
                kept["reason"][row] = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return kept

    def _drawn(self, random: np.random.Generator) -> Recording:
        source = self.source
        if self.method == "blocks" or isinstance(source, Shaken):
            values = source.draw(random)
        else:
            assert isinstance(self.fit, Fit)
            size = np.array([self.fit.residual_std.get(channel, 0.0) for channel in CHANNELS])
            noise = size[:, None] * random.standard_normal(source.simulated.shape)
            values = np.where(np.isfinite(source.error), source.simulated + noise, np.nan)
        again = {e.name: e for e in measured_again(moving(self.recording), source, values)}
        return dataclasses.replace(
            self.recording, experiments=tuple(again.get(e.name, e) for e in self.recording.experiments)
        )

    def _weighed_again(self, random: np.random.Generator) -> RTAC:
        """Return the fitted model with what was measured of constants drawn anew around the estimates."""
        model = self.fit.model
        priors = {
            name: Prior(float(np.asarray(model[name])) + float(prior.std) * random.standard_normal(), float(prior.std))
            for name, prior in model.priors.items()
        }
        return dataclasses.replace(model, priors=priors) if priors else model

    def _refitted(self, recording: Recording, model: RTAC) -> Float[np.ndarray, " parameter"]:
        function = prediction_error_nonlinear if isinstance(self.fit, PredictorFit) else output_error
        found = function(model, recording, from_model=True, progress=False)
        return np.array([found.parameters[name].value for name in self.fit.information.names])
