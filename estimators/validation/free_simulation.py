"""The free simulation of a model in experiments, from the states at the start that follow them best."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from estimators.core.data import Data, in_channels
from estimators.core.fit import Fit
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.core.results import DivergedError
from estimators.core.start_search import searched
from estimators.core.step_size import accurate_substeps
from estimators.prediction_error.fit import PredictorFit
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment

# Longer experiments without memory of their start take it from their beginning alone.
LONG, _BEGINNING = 8192, 2048
HELD = 10.0
"""Times the largest measured value of a channel at which the output of a model that diverges is held."""
_OVER = (
    8  # times that experiments are simulated over and over at most, which costs less than compiling for their number
)
_LOST = 1e100  # an output beyond this has left all bounds, and its square would overflow

Fitted = Fit | PredictorFit | RTAC


def _substeps(fit: Fitted) -> int | None:
    # Predictions need fewer than a simulation.
    return int(fit.statistics["substeps"]) if isinstance(fit, Fit) else None


def simulated_freely(
    model: RTAC,
    label: str,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    known: Mapping[str, np.ndarray] | None,
    start_samples: int | None,
    fit: Fitted,
    lost: dict[str, float] | None = None,
) -> tuple[np.ndarray, dict[str, np.ndarray], int]:
    """Return the outputs with the best start, the starts, and the sample from which on the error counts.

    Args:
        model: that is simulated.
        label: of it, for a refusal.
        experiments: that are simulated.
        levels: standard deviation of the noise by channel.
        known: states at the start by experiment, where a fit has them.
        start_samples: that set the start; None for all.
        fit: whose compiled code serves, and whose steps of integration are taken.
        lost: gets the experiments in which the model leaves all bounds, and after how long [s]; its outputs are held there at
            `HELD` times the largest measured value. None to refuse it.

    Raises:
        DivergedError: the model leaves all bounds, and is not held.
    """
    asked, experiments = experiments, _as_many_as(fit, experiments)
    space = _with_places(fit, space_of(model, experiments, free=[], start=known))
    unknowns, substeps = space.unconstrained(), _substeps(fit)
    noise = in_channels(levels)
    window = start_samples
    longest = max(e.samples for e in experiments)
    if window is None and longest > LONG and all(e.arm == "locked" or "arm_angle" in e.outputs for e in experiments):
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
        found = searched(unknowns, arguments)
        if found is None and lost is not None:
            found = unknowns
        if found is None:
            _outputs(unknowns, whole, label, experiments, None)  # says where
            raise DivergedError(f"the model {label!r} diverges from every start that was tried; check its parameters.")
        unknowns = found
    simulated = _outputs(unknowns, whole, label, experiments, lost)
    missing = np.asarray(everything.present) == 0
    if missing.any():
        simulated = np.where(missing, np.nan, simulated)
    states = np.asarray(space.physical(unknowns)[2])
    starts = {e.name: states[:, i] for i, e in enumerate(asked)}
    return simulated[..., : len(asked)], starts, start_samples or 0


def _as_many_as(fit: Fitted, experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments, over and over until there are as many as were fitted: what the fit compiled serves them too."""
    several = list(experiments)
    if isinstance(fit, RTAC) or not len(several) < len(fit.experiments) <= _OVER * len(several):
        return several
    return [several[n % len(several)] for n in range(len(fit.experiments))]


def _with_places(fit: Fitted, space: Space) -> Space:
    """Return the space of the starts with places past the end for the parameters that the fit estimated, for the same reason."""
    if isinstance(fit, RTAC):
        return space
    count = sum(name not in fit.model.per_experiment for name in fit.model.free)
    return dataclasses.replace(space, active=jnp.full(count, len(space.names), dtype=int))


def _outputs(
    unknowns: Unknowns,
    arguments: Arguments,
    label: str,
    experiments: Sequence[Experiment],
    held: dict[str, float] | None,
) -> np.ndarray:
    """Return the model's outputs in these experiments; held where they leave all bounds, and `held` says where.

    Raises:
        DivergedError: it leaves all bounds in one of them, and is not held.
    """
    error, _ = plain_residual(unknowns, arguments)
    simulated = np.asarray(arguments.data.values) - np.asarray(error)
    measured, present = np.asarray(arguments.data.values), np.asarray(arguments.data.present) > 0
    # A comparison with NaN is false, so NaN counts as lost too.
    lost = present & ~(np.abs(simulated) < _LOST)
    for column, experiment in enumerate(experiments):
        if not lost[..., column].any():
            continue
        instant = experiment.sample_time * float(np.argmax(lost[..., column].any(axis=1)))
        if held is None:
            raise DivergedError(
                f"experiment {experiment.name}: the model {label!r} diverges {instant:.3g} s after the start and cannot be "
                "compared; fit it to this rig again (est.output_error), or check the sign and unit of the parameter last "
                "changed."
            )
        held[experiment.name] = instant
        largest = np.max(np.where(present[..., column], np.abs(measured[..., column]), 0.0), axis=0)
        most = HELD * np.where(largest > 0, largest, 1.0)
        own = np.nan_to_num(simulated[..., column], nan=np.inf, posinf=np.inf)
        simulated[..., column] = np.clip(own, -most, most)
    return simulated
