"""Output error: the simulation that comes nearest to all measurements, with shared physics and separate starts."""

import contextlib
import dataclasses
import time
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from estimators.closed_form.fit import starting_values
from estimators.core.data import CHANNELS, Data, in_channels, mark_of, moving, pieces
from estimators.core.fisher_information import information, told_deviations
from estimators.core.fit import Fit, left_free
from estimators.core.parameter_space import number_of_unknowns
from estimators.core.progress import Progress
from estimators.core.results import RESULTS, DivergedError
from estimators.core.sensor_noise import noise_levels
from estimators.core.threads import one_blas_thread
from estimators.output_error.descent import Descent, DescentEnd
from estimators.output_error.memory import require_memory
from estimators.output_error.robust import without_spikes
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.effect_contract import require_working_model
from rtac_jax.excited_parts import excited_parts
from rtac_jax.measurement import Experiment, Recording

# A second start agrees with the best one when its log-likelihood is within this much for each sample.
_AGREES = 1e-3
# Log-likelihood that the slopes still promise where the steps ran out, from which on a fit goes on from there, led anew: parameters
# near a bound creep, and what leads a fit at its start takes them there at once.
_FAR_FROM_ENDED = 10.0


@checked_arguments
@one_blas_thread()
def output_error(
    model: RTAC,
    recording: Recording,
    *,
    starts: int = 2,
    tolerance: float = 1e-6,
    steps: int = 60,
    from_model: bool = False,
    start: Mapping[str, np.ndarray] | None = None,
    led: bool = True,
    robust: bool = False,
    progress: bool = True,
) -> Fit:
    """Fit a model to all moving experiments of a recording at once by its simulation error.

    What was measured of constants beforehand (`RTAC.priors`, which `RTAC.from_rig` takes from `NAME_std` of a recording) is
    counted beside the measurements, so that constants are estimated and standard deviations count their uncertainty.

    The first start is the closed form, the second the values of the model itself, further ones are drawn around the first.
    From each it goes by one-step-ahead predictions with ever weaker correction to the free simulation; from the model's own
    values without, where its simulation follows the motion already.

    Args:
        model: gives the free parameters and the values of the second start.
        recording: with moving experiments; those at rest tell the sensors' noise.
        starts: number of starts to try.
        tolerance: relative change at which the optimiser stops.
        steps: optimiser steps in each stage.
        from_model: begin at the model's values only, as after adding an effect to a model that was fitted.
        start: states beside the model's values to begin at, by experiment, as `Compared.start` has them; by default what the first
            samples show.
        led: let predictions lead on where the model's values are near the data and `steps` end before the descent does, and short
            parts of the data where these do not; False where models are only ranked.
        robust: let samples that lie too far off for noise, as spikes and dropouts do, count for little, and list them; see
            `estimators.output_error.robust`. The standard deviations allow for it. What a missing effect leaves may be
            discounted too, so look at the list.
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        ValueError: nothing moves in the recording, no parameter is free, or a user's own effect does not work.
        TooLargeError: the recording does not fit into the memory that is free.
        NotIdentifiableError: the data leave parameters free at the start; `unseen` names those of effects that show nowhere, which
            `est.improve` and the command line hold at their values. Where they do so only where the fit ended, as a model
            that lacks much may run off, its `result` is `RESULTS.undetermined`.
        DivergedError: the model diverges from every start.
        RuntimeError: JAX was not configured for double precision.

    Source: Ljung, System Identification (1999), chapter 7; optimistix's LevenbergMarquardt.
    """
    require_configured()
    began = time.perf_counter()
    experiments = pieces(moving(recording))
    require_working_model(model, batch=False)
    if not model.free:
        raise ValueError("The model has no free parameter; release one with model.release(name).")
    levels = noise_levels(recording.experiments)
    note = require_memory(model, experiments)
    data = Data.of(experiments)
    first, whole = recording, (data, experiments)
    if robust:  # what is surely a fault would lead every start astray before weights are known
        first = dataclasses.replace(recording, experiments=tuple(without_spikes(e) for e in recording.experiments))
        experiments = pieces(moving(first))
        data = Data.of(experiments)
    candidates = [("the model's values", model)] if from_model else _starts(model, first, experiments, starts)
    with Progress("output error", show=progress) as shown:
        if note:
            shown.say(note)
        run = Descent(data, experiments, levels, tolerance, steps, shown)
        ends: list[tuple[str, DescentEnd]] = []
        failures = []
        for name, begin in candidates:
            shown.at(f"output error from {name}")
            given = begin is model
            try:
                end = run.descend(
                    begin, best=min((end.cost for _, end in ends), default=np.inf), given=given, led=led,
                    start=start if given else None,
                )  # fmt: skip
                if end is not None:
                    ends.append((name, end))
            except FloatingPointError as error:
                failures.append(f"from {name}: {error}")
        if not ends:
            raise DivergedError(" ".join(failures))
        winner, stage = min(ends, key=lambda end: end[1].cost)
        noise = in_channels(levels)
        # Far from the data it was led already, and a model that lacks something creeps on for hundreds of steps.
        if led and not stage.solved.converged and stage.solved.promised > _FAR_FROM_ENDED and not stage.is_far(noise):
            shown.at(f"output error again, from where that from {winner} ended")
            with contextlib.suppress(FloatingPointError):
                again = run.descend(_with_end(stage), best=stage.cost, given=True)
                if again is not None and again.cost < stage.cost:
                    ends = [(name, again if end is stage else end) for name, end in ends]
                    stage = again
        agreed = sum(_same(end, stage, float(jnp.sum(data.present))) for _, end in ends)
        weighted = None
        if robust:
            shown.at("output error, weighted")
            data, experiments = whole
            weighted = run.weighted(stage, data, experiments)
            stage = dataclasses.replace(stage, solved=weighted.solved, deviation=weighted.deviation, cost=weighted.cost)
    found = information(stage.solved.factor, stage.space, stage.solved.unknowns)
    states = np.asarray(stage.space.physical(stage.solved.unknowns)[2])
    model = _with_end(stage)
    # The data were asked before the first step: what they leave free at the end is lost on the way.
    free = left_free(model, found)
    if weighted is not None and found.scores is not None:
        found = dataclasses.replace(found, scores=weighted.score_ratio * found.scores)
    crept = stage.solved.crept
    if not (stage.solved.converged or crept) or (weighted is not None and not weighted.settled):
        result = RESULTS.steps_exhausted
    elif free:
        result = RESULTS.undetermined
    elif crept:
        result = RESULTS.crept
    elif stage.solved.pulled:
        result = RESULTS.pulled_off_bound
    elif len(candidates) > 1 and agreed < 2:
        result = RESULTS.starts_disagree
    else:
        result = RESULTS.successful
    return Fit(
        model=model,
        result=result,
        information=found,
        each_std=told_deviations(stage.solved.factor, stage.space, stage.solved.unknowns),
        noise=levels,
        residual_std={c: float(s) for c, s in zip(CHANNELS, stage.deviation, strict=True) if c in levels},
        start={e.name: states[:, i] for i, e in enumerate(experiments)},
        experiments=tuple(e.name for e in experiments),
        statistics={
            "cost": stage.cost,
            "promised": stage.solved.promised,
            "pulled": stage.solved.pulled,
            "steps": run.taken,
            "starts": len(candidates),
            "agreed": agreed,
            "winner": winner,
            "failures": tuple(failures),
            "substeps": stage.substeps,
            "samples": {
                c: int(n)
                for c, n in zip(CHANNELS, np.asarray(data.present).sum(axis=(0, 2)), strict=True)
                if c in levels
            },
            "unknowns": number_of_unknowns(stage.space, stage.solved.unknowns),
            "unexcited": tuple(sorted(excited_parts(recording)[1])),
            "in_pieces": len(experiments) > len(moving(recording)),
            "seconds": time.perf_counter() - began,
            **({} if weighted is None else {"score_ratio": weighted.score_ratio}),
        },
        marks={e.name: mark_of(e) for e in experiments},
        discounted=() if weighted is None else weighted.discounted,
        weights={}
        if weighted is None
        else {e.name: weighted.weights[: e.samples, :, i] for i, e in enumerate(experiments)},
    )


def _starts(model: RTAC, recording: Recording, experiments: Sequence[Experiment], count: int) -> list[tuple[str, RTAC]]:
    first = starting_values(model, recording)
    found = [("the closed form", first)]
    if count > 1:
        found.append(("the model's values", model))
    random = np.random.default_rng(0)
    for number in range(2, count):
        factors = {name: float(np.asarray(first[name])) * random.uniform(0.8, 1.2) for name in first.free}
        factors |= {name: float(np.asarray(first[name])) for name in first.uncertain}
        found.append((f"draw {number - 1}", first.with_values(factors)))
    return found


def _with_end(stage: DescentEnd) -> RTAC:
    """Return the model with the values at which a descent ended."""
    shared, each, _ = (np.asarray(part) for part in stage.space.physical(stage.solved.unknowns))
    values = dict(zip(stage.space.names, shared, strict=True)) | dict(zip(stage.space.each, each, strict=True))
    return stage.model.with_values(values)


def _same(end: DescentEnd, best: DescentEnd, samples: float) -> bool:
    """Return whether a descent ended where the best one did: at the same likelihood, or at the same parameters."""
    if end.cost <= best.cost + _AGREES * samples:
        return True
    there, here = (np.asarray(s.space.physical(s.solved.unknowns)[0]) for s in (end, best))
    return bool(np.all(np.abs(there - here) <= 1e-4 * np.maximum(np.abs(here), 1e-3 * np.asarray(best.space.scale))))
