"""The three bullets that a report begins with: what was found, how sure that is, and what to do next."""

import math
import shlex
from collections.abc import Mapping, Sequence

from estimators.controller.outcome import ControlDesign, outcome
from estimators.core.fit import FAR, Fit, Parameter
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.experiment_design.next_experiment import NextExperiment
from estimators.plots.envelope import finding
from estimators.reporting.html import Bullets
from estimators.uncertainty.envelope import Envelope
from estimators.validation.recommendation import Recommendation
from estimators.validation.simulation_error import Compared, Comparison

_AS_FAR = (
    "Use the model as far as its held-out error is good enough; what else is missing shows where the force below acts."
)
_NOISE = 1.2  # error over noise up to which a model follows the data, as in the titles of the pictures


def of_fit(fit: Fit, advice: Recommendation, trained: Comparison, tested: Comparison | None, *, file: str) -> Bullets:
    """Return the bullets of a fit.

    Args:
        fit: of output error.
        advice: which estimates to use.
        trained: the fit on what was fitted.
        tested: the same on what was held out.
        file: name of the recording.
    """
    against = (tested or trained).models[0]
    free = [(name, p) for name, p in advice.parameters.items() if name in fit.information.names and p.value]
    known = sorted(free, key=lambda pair: abs(pair[1].std / pair[1].value))
    worst = f"; worst known: {_parameter(*known[-1])}" if known else ""
    best = f" Best known: {_parameter(*known[0])}{worst}." if known else ""
    return Bullets(
        f"{len(fit.information.names)} parameters; {_error(against, tested is not None)}.", f"{advice.sentence}{best}",
        _after(against, file, "a controller (rtac envelope, rtac control), given recordings of several conditions"),
    )  # fmt: skip


def of_comparison(trained: Comparison, tested: Comparison | None, *, file: str) -> Bullets:
    """Return the bullets of a comparison, of several models of that which follows best; arguments as of `of_fit`."""
    models = (tested or trained).models
    best, *others = sorted(models, key=_largest)
    white = sum(trace.colour == "white" for trace in best.traces)
    kind = "held out" if tested is not None else "fitted, so that nothing validates them"
    error = _error(best, tested is not None)
    found = f"{error[0].upper()}{error[1:]}"
    whose = ""
    if others:
        beside = ", ".join(f"{one.label} {_largest(one):.3g}" for one in others)
        found = f"{best.label} follows the data best: {error}; {beside}"
        whose = f" of {best.label}"
    return Bullets(
        f"{found}.",
        (tested or trained).several_ahead
        or f"{white} of {len(best.traces)} residuals{whose} are white at 1 %; these experiments were {kind}.",
        _after(best, file, f"nothing: {best.label if others else 'the model'} follows these data to their noise"),
    )


def of_diagnosis(
    found: Diagnosis | Improvement,
    trained: Comparison,
    tested: Comparison | None,
    *,
    file: str,
    estimates: Mapping[str, Parameter] | None = None,
    doubts: Sequence[str] = (),
) -> Bullets:
    """Return the bullets of a diagnosis or of a loop of them.

    Args:
        found: what it found.
        trained: every model on what was fitted.
        tested: the same on what was held out.
        file: name of the recording.
        estimates: that are recommended.
        doubts: contradictions in the recording.
    """
    effects = found.added if isinstance(found, Improvement) and found.added else _named(found)
    # What a model holds after all else was fitted beside it; a diagnosis estimates before that.
    final = estimates or (found.final.parameters if isinstance(found, Improvement) else {})
    named = "; ".join(_effect(c, final) for c in effects)
    last = found.diagnoses[-1] if isinstance(found, Improvement) else found
    on_the_way = f"; added on the way: {named}" if named else ""
    if named and isinstance(found, Improvement) and not found.added:
        on_the_way = f"; what a diagnosis names, {named}, does not serve held-out experiments and was not added"
    in_time = ", as far as was asked before the time was over" if last.broken_off else ""
    whats = {
        "adequate": f"Nothing is missing from the model {last.floor}{in_time}",
        "missing": f"Missing: {named}" if named else "An effect is missing",
        "ambiguous": f"One of a group is missing, and these data cannot tell which: {named}",
        "unknown": f"The model fails, and {last.no_effect} explains it{on_the_way}",
    }
    if last.line_alone:
        whats["unknown"] = f"Only a line speaks against the model{on_the_way}: {last.line_alone}"
    elif last.rounding:
        whats["unknown"] = f"What speaks against the model may be rounding{on_the_way}: {last.rounding}"
    if last.drift:
        whats["unknown"] = f"The model fails as where a parameter drifts{on_the_way}: {last.drift}"
    what = whats[found.verdict]
    learned = found.learned if isinstance(found, Improvement) else None
    late = isinstance(found, Improvement) and bool(found.not_added) and not found.added
    if late:
        what = f"The model fails; missing, and not added before the time was over: {named}"
    elif isinstance(found, Improvement) and named and found.verdict in ("adequate", "missing"):
        rest = f"; nothing more is missing {last.floor}{in_time}" if found.verdict == "adequate" else ""
        what = f"Was missing, and is in the model now: {named}{rest}"
    if isinstance(found, Improvement) and found.added and found.verdict == "ambiguous":
        alike = "; ".join(f"{c.id} from {', '.join(c.confusable_with)}" for c in found.added if c.confusable_with)
        what = f"Was missing, and is in the model now: {named}. But these data cannot tell {alike}, which may be it as well"
    if learned is not None:
        what += (
            f". As a last resort a learned force was added, which is no physical effect: on the {learned.port} against "
            f"{learned.variable.replace('_', ' ')}"
        )
    nearest = found.nearest if isinstance(found, Improvement) else None
    if nearest is not None:
        what += (
            f". As a last resort the nearest, {_effect(nearest, final)}, was added, which explains "
            f"{100 * nearest.error_reduction:.0f} % of what was left: likely, not certain"
        )
    before, after = ((tested or trained).models[n] for n in (0, -1))
    sure = f"{_error(before, tested is not None)}"
    if before is not after:
        ratio = {c: (e.rms_over_noise, after.errors[c].rms_over_noise) for c, e in before.errors.items()}
        falls = ", ".join(f"{channel.replace('_', ' ')} {a:.3g} to {b:.3g}" for channel, (a, b) in ratio.items())
        kind = "experiments that no fit has seen" if tested is not None else "the fitted experiments"
        sure = f"error over noise on {kind}: {falls}"
    rivals = sorted({name for c in effects for name in c.confusable_with})
    told = [f"{c.id} by a BIC gain of {c.bic_gain:,.0f}" for c in effects if c.bic_gain > 0]
    sure += f"; {' and '.join(told)}" if told else ""
    sure += f"; confusable with {', '.join(rivals)}" if rivals else ""
    steps = {
        "adequate": "Use the model: a controller (rtac envelope, rtac control), given recordings of several conditions.",
        "missing": f"rtac improve {shlex.quote(file)}, which adds it and goes on.",
        "ambiguous": "Record the experiment that tells them apart, if one could be planned (next_experiment.h5), join it, and "
        "diagnose again; else measure by itself what they stand for.",
        "unknown": "Look where and at which frequency the force acts (below), and give an effect of your own with --effects.",
    }
    more_time = "Give more time (--within), or a part of the recording: not all was fitted before the time was over."
    if isinstance(found, Improvement) and found.broken_off:
        steps["unknown"] = more_time
    if last.drift:
        steps["unknown"] = (
            "Let the rig run before it is recorded, or fit shorter experiments and hold them against each other."
        )
    if isinstance(found, Improvement):
        steps["missing"] = "Use the model with it, in the range of motion that was recorded."
        if found.added and found.mended != "adequate" and not last.line_alone:
            steps["missing"] = _AS_FAR
    if _largest(after) > FAR:
        mended = isinstance(found, Improvement) and found.mended == "adequate"
        steps["missing" if mended else "adequate"] = (
            "Take the parameters from predictions (est.prediction_error_nonlinear): no simulation follows the rig. A record at "
            "rest and a repeat tell random forces from what is missing."
        )
    if late:
        steps[found.verdict] = more_time
    if nearest is not None:
        steps[found.verdict] = _AS_FAR
    if learned is not None:
        low, high = learned.between
        steps[found.verdict] = (
            f"Use the model between {low:.3g} and {high:.3g} {learned.variable_unit} of {learned.variable.replace('_', ' ')} only, "
            "where the force was learned; try one of the laws below, or an effect of your own with --effects."
        )
    differing = found.constancy if isinstance(found, Improvement) else None
    if differing is not None and differing.decisive:
        what += f"; {differing.varying[0]} differs between experiments"
    if differing is not None and differing.outlying is not None and differing.outlying.decisive:
        name = differing.outlying.name
        what += f"; {name} alone differs from all other experiments"
        after_that = steps[found.verdict]
        if isinstance(found, Improvement) and found.left_out is not None:
            what += ", and the last model is fitted without it"
            after_that = "The last model follows the others."
        steps[found.verdict] = (
            f"Look at {name}: its sample time, lost samples or counts, a sensor that was set anew, what touched "
            f"the rig, or what it alone shows; then again without it. {after_that}"
        )
    if doubts and last.verdict == "unknown":
        steps[found.verdict] = f"Mend the recording first, or leave out what is wrong, and ask again. {doubts[0]}"
    return Bullets(f"{what}.", f"{sure[0].upper()}{sure[1:]}.", steps[found.verdict])


def of_envelope(found: Envelope, warnings: list[str], *, file: str) -> Bullets:
    """Return the bullets of an envelope; `warnings` say where the fitted model does not meet it."""
    step = warnings[-1] if warnings else f"rtac control {shlex.quote(file)}."
    return Bullets(f"{finding(found)}.", f"{found.coverage}. {warnings[0] if warnings else ''}".strip(), step)


def of_control(found: ControlDesign, warnings: list[str]) -> Bullets:
    """Return the bullets of a controller; `warnings` say where the fitted model does not meet the envelope."""
    said = outcome(found)
    held = found.fractions["parameter_covariance"]
    sure = f"{100 * held:.1f} % of plants drawn from the covariance of the fit hold; {found.covered.coverage}."
    step = "Load controller.mat, or the matrices of the JSON, and try it on the rig with the torque limited."
    if not found.helps:
        step = "Do not use it; see below what narrows the envelope."
    return Bullets(said[0], " ".join([sure, *warnings[:1]]), warnings[-1] if warnings else step)


def _named(found: Diagnosis | Improvement) -> tuple[Candidate, ...]:
    return found.diagnoses[0].effects if isinstance(found, Improvement) else found.effects


def _effect(candidate: Candidate, final: Mapping[str, Parameter]) -> str:
    inside = ", ".join(
        f"{name} {p.value:.4g}{f' +- {p.std:.2g}' if math.isfinite(p.std) and p.std else ''} {p.unit}".removesuffix(
            " 1"
        )
        for name, p in ((n, final.get(f"{candidate.id}.{n}", p)) for n, p in candidate.parameters.items())
    )
    return f"{candidate.id}{f' ({inside})' if inside else ''}"


def _parameter(name: str, p: object) -> str:
    value, std, unit = (getattr(p, part) for part in ("value", "std", "unit"))
    return f"{name} {value:.5g} +- {std:.2g}{'' if unit == '1' else f' {unit}'} ({100 * abs(std / value):.2g} %)"


def _largest(compared: Compared) -> float:
    """Return the largest error over the noise."""
    worst = compared.worst(1)[0]
    return worst.rms / worst.noise


def _error(compared: Compared, held_out: bool) -> str:
    worst = compared.worst(1)[0]
    kind = "held-out" if held_out else "fitted"
    return (
        f"the model leaves at most {_largest(compared):.3g} times the noise of the {kind} experiments, in "
        f"{worst.channel.replace('_', ' ')} of {worst.experiment}"
    )


def _after(compared: Compared, file: str, good: str) -> str:
    if _largest(compared) > _NOISE:
        return f"rtac diagnose {shlex.quote(file)}, which says what is missing."
    return f"{good[0].upper()}{good[1:]}."


def of_next_experiment(planned: NextExperiment, *, file: str) -> Bullets:
    """Return the bullets of a planned experiment: which, how far it separates, and what to do with it."""
    first, sure, *_ = str(planned).splitlines()
    added = f"rtac import {shlex.quote(file)} MEASURED.csv {shlex.quote(file)} --kind {planned.plan.kind} ..."
    spared = f" It may not be needed: hold out others than {', '.join(planned.deciding)}." if planned.deciding else ""
    return Bullets(
        first.removeprefix("Next experiment: "),
        sure,
        f"Play it on the rig, add it ({added}), and diagnose again, with others held out (--validation).{spared}",
    )
