"""The estimates from the recordings of one chunk, by one method."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.closed_form.fit import least_squares
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of
from estimators.core.results import RESULTS
from estimators.diagnosis.diagnose import diagnose
from estimators.frequency_response.estimate import frequency_responses
from estimators.linear.fit import prediction_error
from estimators.output_error.fit import output_error
from estimators.prediction_error.fit import PredictorFit, prediction_error_nonlinear
from estimators.study.batched_fits import fit_together, suits
from estimators.study.outcome import Outcome, Prepared, Value
from estimators.study.recordings import NEW
from estimators.study.spec import Estimate, StudySpec, options_for, parameter_names
from estimators.study.truth import RATIOS, Truth, the_paper
from estimators.uncertainty.envelope import envelope
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Recording

LINEAR = ("natural frequency", "damping ratio")
"""What the linear prediction error estimates; the truth is that of the model about theta = 0, without dry friction."""

QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "least_squares": (),
    "weak_form": (),
    "output_error": ("residual",),
    "prediction_error_nonlinear": ("residual", "force_noise", "torque_noise"),
    "prediction_error": ("undamped",),
    "envelope": ("stated", "confidence", "inside", "largest_gap", "excess_db"),
    "diagnosis": ("residual", "removed", "likeness"),
}
"""Numbers that a method gives besides parameters: largest residual over noise; random force and torque as spectral densities;
how many conditions were left out as only the bound on stability keeps a mode there; the probability that an envelope states, with
which confidence, the fraction of new conditions inside, its largest model error and how far it lies above it; the fraction of
misfit that named effects remove, and how much the hidden effect looks like its nearest rival."""


def fit_chunk(estimate: Estimate, chunk: Sequence[Prepared], start: str) -> list[Outcome | str]:
    """Estimate from every recording of a chunk; where that fails, the reason.

    Fits of output error that begin at the truth are made side by side in one compiled batch. Whether they are, and what each
    comes to, follows from the study and from the repetition alone; those that the batch leaves open are fitted alone.
    """
    options = dict(estimate.options)
    together: list[Outcome | None] = [None] * len(chunk)
    if suits(estimate, start):
        together = fit_together(chunk, options)
    found: list[Outcome | str] = []
    for prepared, outcome in zip(chunk, together, strict=True):
        found.append(outcome or _alone(estimate, prepared, options, start))
    return found


def _alone(estimate: Estimate, prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome | str:
    try:
        return _METHODS[estimate.method](prepared, options, start)
    except MemoryError:
        raise  # says nothing of the repetition: the chunk is tried again
    except Exception as error:  # whatever it is, it is a result of the study, and kept with its reason
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


def model_for(spec: StudySpec, truth: Truth, recording: Recording) -> RTAC:
    """Return the model to be fitted, at the values where the fit begins."""
    model = RTAC.from_rig(recording)
    for effect in spec.model.effects:
        model = model + CATALOGUE[effect].candidates(scales_of(model, [e for e in recording if e.kind != "rest"]))[0]
    known: dict[str, float] = {}
    held = [name for name in model.free if spec.model.free and name not in spec.model.free]
    if spec.model.start == "truth":
        known |= {name: truth.values[name] for name in model.free if name in truth.values}
    known |= {name: truth.values[name] for name in held if name in truth.values}
    begun = the_paper()[1]  # as `from_rig` has it, but for constants of the recording
    model = model.with_values({n: v for n, v in known.items() if n in recording.rig or v != begun.get(n)})
    return model.fix(*held) if held else model


def parameters_of(spec: StudySpec) -> tuple[str, ...]:
    """Return all that the estimators of a study may estimate, and a few besides."""
    methods = {estimate.method for estimate in spec.estimate}
    own = [n for n in parameter_names(spec.model.effects) if n not in ("total_mass", "arm_inertia")]
    names = [n for n in own if not spec.model.free or n in spec.model.free]
    if methods & {"least_squares", "weak_form"} and not spec.model.free:
        names += list(RATIOS)
    return (*names, *(LINEAR if "prediction_error" in methods else ()))


def _from_model(function: Callable[..., Any], options: Mapping[str, Any], start: str) -> dict[str, Any]:
    """Return the function's options; a study that begins at the truth begins at the model."""
    first = {"from_model": True} if start == "truth" else {}
    return first | options_for(function, options) | {"progress": False}


def _closed_form(prepared: Prepared, options: Mapping[str, Any], weak: bool) -> Outcome:
    chosen: dict[str, Any] = {"weak": weak} | dict(options)
    found = least_squares(prepared.model, prepared.recording, **chosen)
    estimates = {**found.ratios, **found.estimates}
    if not estimates:
        raise ValueError(next(iter(found.skipped.values()), "no experiment serves the closed form."))
    return Outcome(
        {n: Value(e.value, e.std, max(len(e.each) - 1.0, 0.0), e.consistency) for n, e in estimates.items()},
        verdict="consistent" if found.consistent else "not consistent",
    )


def _least_squares(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    return _closed_form(prepared, options, weak=False)


def _weak_form(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    return _closed_form(prepared, options, weak=True)


def _shared(found: Fit | PredictorFit) -> dict[str, Value]:
    return {n: Value(found.parameters[n].value, found.parameters[n].std) for n in found.information.names}


def _output_error(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    found = output_error(prepared.model, prepared.recording, **_from_model(output_error, options, start))
    return Outcome(_shared(found), {"residual": _residual(found)}, _ended(found))


def _residual(fit: Fit) -> float:
    return max(rms / fit.noise[channel] for channel, rms in fit.residual_std.items())


def _ended(fit: Fit) -> str:
    ended = (n for n in ("successful", "starts_disagree") if bool(fit.result == getattr(RESULTS, n)))
    return next(ended, "steps_exhausted")


def _prediction_error_nonlinear(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    function = prediction_error_nonlinear
    found = function(prepared.model, prepared.recording, **_from_model(function, options, start))
    quantities = {
        "residual": max(w.rms for w in found.whiteness),
        "force_noise": found.force_noise,
        "torque_noise": found.torque_noise,
    }
    white = "white" if found.verdict.startswith("The innovations are white") else "coloured"
    return Outcome(_shared(found), quantities, white)


def _prediction_error(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    """Return the mean over the conditions of a repetition, each counting by its stated precision, with its scatter over them.

    A condition in which only the bound on stability keeps a mode tells of noise, and is left out.

    Raises:
        ValueError: fewer than two conditions are left.
    """
    recording = prepared.recording
    angle = all("arm_angle" in e.outputs for e in recording if e.kind == "forced")
    model = None if angle else output_error(prepared.model, recording, progress=False).model
    found = prediction_error(recording, model=model, progress=False, **dict(options))
    kept = [one for one in found.models if not one.undamped]
    if len(kept) < 2:
        raise ValueError(f"in {len(found.models) - len(kept)} of {len(found.models)} conditions a mode has no damping.")
    values = {}
    for name in LINEAR:
        own = next(n for n in found.models[0].names if n.startswith(name))  # of the first mode, where there are several
        place = found.models[0].names.index(own)
        values[name] = _weighted_mean(
            *(np.array([getattr(one, of)[place] for one in kept]) for of in ("values", "std"))
        )
    quantities = {"undamped": float(len(found.models) - len(kept))}
    return Outcome(values, quantities, "converged" if all(one.converged for one in kept) else "not converged")


def _weighted_mean(values: Float[np.ndarray, " condition"], std: Float[np.ndarray, " condition"]) -> Value:
    """Return the mean weighted by stated precision, its deviation by the scatter, and how many degrees of freedom that has.

    Few conditions may have most of the weight, and then count as so many only (Kish, Survey Sampling, 1965, section 11.7): with
    one less than their number, intervals at 95 % held 76 to 92 % of 4,000 means of conditions as precise as one another
    within a factor of e^0.5 or e (one deviation).
    """
    weights = 1 / std**2
    total, mean = float(np.sum(weights)), float(np.average(values, weights=weights))
    scatter = np.sum((weights * (values - mean)) ** 2) * len(values) / (len(values) - 1)
    freedom = total**2 / float(np.sum(weights**2)) - 1
    return Value(mean, float(np.sqrt(scatter)) / total, max(freedom, 1.0))


def _envelope(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    recording = prepared.recording
    new = [name for name in recording.names if name.startswith(NEW)]
    chosen = options_for(frequency_responses, options)
    responses = frequency_responses(recording.select([n for n in recording.names if n not in new]), **chosen)
    made = envelope(responses, progress=False, **options_for(envelope, options))
    inside = made.covers(frequency_responses(recording.select(new), **chosen)) if new else np.zeros(0)
    quantities = {
        "stated": made.coverage.probability,
        "confidence": made.coverage.confidence,
        "inside": float(np.mean(inside)) if new else np.nan,
        "largest_gap": float(np.max(made.profile)),
        "excess_db": made.excess_db,
    }
    return Outcome(quantities=quantities, verdict=made.coverage.method)


def _diagnosis(prepared: Prepared, options: Mapping[str, Any], start: str) -> Outcome:
    fit = output_error(prepared.model, prepared.recording, **_from_model(output_error, {}, start))
    chosen = dict(options)
    if "candidates" in chosen:
        chosen["candidates"] = [CATALOGUE[name] for name in chosen["candidates"]]
    found = diagnose(fit, prepared.recording, progress=False, **chosen)
    groups = {c.id: c.confusable_with for c in found.effects}
    named = ["|".join((effect.id, *groups.get(effect.id, ()))) for effect in found.additions]
    own = [c for c in found.candidates if c.id == prepared.truth.hidden.effect]
    likeness = max((abs(x) for x in own[0].correlation.values()), default=np.nan) if own else np.nan
    quantities = {"residual": _residual(fit), "removed": found.removed, "likeness": float(likeness)}
    return Outcome(quantities=quantities, verdict=found.verdict, named=" + ".join(named))


_METHODS: Mapping[str, Callable[[Prepared, Mapping[str, Any], str], Outcome]] = {
    "least_squares": _least_squares,
    "weak_form": _weak_form,
    "output_error": _output_error,
    "prediction_error_nonlinear": _prediction_error_nonlinear,
    "prediction_error": _prediction_error,
    "envelope": _envelope,
    "diagnosis": _diagnosis,
}
