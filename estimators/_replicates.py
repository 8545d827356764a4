"""Recordings as they might have come out too: a fitted simulation plus its own residual in another order."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators._at_fit import Problem, at_fit, rows_at, with_outputs
from estimators._least_squares import ClosedForm, closed_form
from estimators._levenberg_marquardt import plain_residual
from estimators._noise import noise_levels
from estimators._output_error import Fit, diagonal_whitener, moving
from estimators._problem import CHANNELS
from rtac_jax.measurement import Experiment, Recording

Outputs = Float[np.ndarray, "sample output experiment"]
_EXCESS = 1.5
Estimator = Callable[[Outputs], Float[np.ndarray, " parameter"]]


@dataclasses.dataclass(frozen=True)
class Replicates:
    """Simulated measurements of a fit, and its residual to be put in another order.

    Attributes:
        problem: of the fit.
        simulated: by the fit, SI units.
        error: measured less simulated; NaN where nothing was measured.
        block: samples that stay together, per experiment.
    """

    problem: Problem
    simulated: Outputs
    error: Outputs
    block: tuple[int, ...]

    @classmethod
    def of(cls, fit: Fit, recording: Recording, *, block: float) -> "Replicates":
        """Around a fit and the recording that it was made from, in blocks of this many seconds.

        Where the sensors' noise was recorded at rest or stated and the residual is clearly above it, the residual is made
        as large as the noise: were the model right, there would be no more.
        """
        problem = at_fit(fit, recording)
        arguments = dataclasses.replace(
            problem.arguments, whitener=diagonal_whitener(np.ones(len(CHANNELS)), problem.arguments.data)
        )
        error = np.array(plain_residual(problem.unknowns, arguments)[0])
        present = np.asarray(problem.arguments.data.present) > 0
        measured = np.asarray(problem.arguments.data.values)
        lengths = tuple(max(1, round(block / e.sample_time)) for e in problem.experiments)
        simulated = measured - error
        known = any(e.kind == "rest" for e in recording.experiments)
        for row, channel in enumerate(CHANNELS):
            stated = any(e.outputs[channel].noise_std is not None for e in problem.experiments if channel in e.outputs)
            if channel in fit.noise and (known or stated):
                excess = fit.residual_std[channel] / fit.noise[channel]
                error[:, row] /= excess if excess > _EXCESS else 1.0
        return cls(problem, simulated, np.where(present, error, np.nan), lengths)

    def draw(self, random: np.random.Generator) -> Outputs:
        """Another set of measurements: blocks of the residual, all channels together, in random order on a circle.

        Source: Politis and Romano, in Exploring the Limits of Bootstrap (1992): circular blocks.
        """
        drawn = np.full(self.error.shape, np.nan)
        for i, (e, length) in enumerate(zip(self.problem.experiments, self.block, strict=True)):
            starts = random.integers(0, e.samples, -(-e.samples // length))
            index = (starts[:, None] + np.arange(length)).ravel()[: e.samples] % e.samples
            shuffled = self.error[index, :, i]
            # A gap stays where it was; a gap that moved in is filled with nothing.
            present = np.isfinite(self.error[: e.samples, :, i])
            drawn[: e.samples, :, i] = np.where(present, np.nan_to_num(shuffled), np.nan)
        return self.simulated + drawn


def estimator_of(
    result: ClosedForm | Fit, names: Sequence[str], replicates: Replicates, recording: Recording
) -> tuple[Estimator, Float[np.ndarray, " parameter"]]:
    """How a result's parameters would come out from other measurements, and how they came out from these.

    A closed form is computed anew; a fit takes one Gauss-Newton step from where it is.
    """
    if isinstance(result, ClosedForm):
        experiments = moving(recording)
        levels = noise_levels(recording.experiments)

        def again(values: Outputs) -> np.ndarray:
            found = closed_form(
                result.model, _measured(experiments, replicates, values), levels, result.options, settled=True
            )
            return np.array([found.estimates[n].pooled if n in found.estimates else np.nan for n in names])

        return again, np.array([result.estimates[n].pooled for n in names])

    problem = (
        replicates.problem if list(result.experiments) == [e.name for e in replicates.problem.experiments] else None
    )
    if problem is None:
        raise ValueError("the fits used different experiments; fit them to the same recording.")
    problem = at_fit(result, recording)
    rows = rows_at(problem)
    flat = rows.jacobian.reshape(-1, rows.jacobian.shape[-1])
    step = -np.linalg.solve(flat.T @ flat, flat.T)
    here = np.array([result.parameters[n].value for n in problem.names])
    chosen = [problem.names.index(n) for n in names]

    def stepped(values: Outputs) -> np.ndarray:
        arguments = with_outputs(problem, jnp.asarray(np.nan_to_num(values)))
        error = np.asarray(plain_residual(problem.unknowns, arguments)[0])
        return (here + step @ error.ravel())[chosen]

    return stepped, here[chosen]


def _measured(experiments: Sequence[Experiment], replicates: Replicates, values: Outputs) -> list[Experiment]:
    """The experiments with other measurements; pieces of a long experiment are put together again."""
    columns: dict[str, list[np.ndarray]] = {}
    for i, piece in enumerate(replicates.problem.experiments):
        columns.setdefault(piece.name.split("[")[0], []).append(values[: piece.samples, :, i])
    found = []
    for e in experiments:
        if e.name not in columns:
            continue
        table = np.concatenate(columns[e.name])
        outputs = {
            c: dataclasses.replace(s, values=table[:, CHANNELS.index(c)]) for c, s in e.outputs.items() if c in CHANNELS
        }
        found.append(dataclasses.replace(e, outputs=outputs))
    return found
