"""The three bullets that a report begins with: what was found, how sure that is, and what to do next; of a diagnosis elsewhere."""

import shlex

from estimators.controller.outcome import ControlDesign, left_far, outcome
from estimators.core.fit import Fit
from estimators.experiment_design.next_experiment import NextExperiment
from estimators.plots.envelope import finding
from estimators.reporting.html import Bullets
from estimators.reporting.largest_error import largest, largest_error
from estimators.uncertainty.envelope import Envelope
from estimators.validation.recommendation import Recommendation
from estimators.validation.simulation_error import Compared, Comparison

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
        f"{len(fit.information.names)} parameters; {largest_error(against, tested is not None)}.", f"{advice.sentence}{best}",
        _after(against, file, "a controller (rtac envelope, rtac control), given recordings of several conditions"),
    )  # fmt: skip


def of_comparison(trained: Comparison, tested: Comparison | None, *, file: str) -> Bullets:
    """Return the bullets of a comparison, of several models of that which follows best; arguments as of `of_fit`."""
    models = (tested or trained).models
    best, *others = sorted(models, key=largest)
    white = sum(trace.colour == "white" for trace in best.traces)
    kind = "held out" if tested is not None else "fitted, so that nothing validates them"
    error = largest_error(best, tested is not None)
    found = f"{error[0].upper()}{error[1:]}"
    whose = ""
    if others:
        beside = ", ".join(f"{one.label} {largest(one):.3g}" for one in others)
        found = f"{best.label} follows the data best: {error}; {beside}"
        whose = f" of {best.label}"
    return Bullets(
        f"{found}.",
        (tested or trained).several_ahead
        or f"{white} of {len(best.traces)} residuals{whose} are white at 1 %; these experiments were {kind}.",
        _after(best, file, f"nothing: {best.label if others else 'the model'} follows these data to their noise"),
    )


def of_envelope(found: Envelope, warnings: list[str], *, file: str) -> Bullets:
    """Return the bullets of an envelope; `warnings` say where the fitted model does not meet it."""
    step = warnings[-1] if warnings else f"rtac control {shlex.quote(file)}."
    return Bullets(f"{finding(found)}.", f"{found.coverage}. {warnings[0] if warnings else ''}".strip(), step)


def of_control(found: ControlDesign, warnings: list[str]) -> Bullets:
    """Return the bullets of a controller; `warnings` say where the fitted model does not meet the envelope."""
    said = outcome(found)
    held = found.fractions["parameter_covariance"]
    sure = f"{100 * held:.1f} % of plants drawn from the covariance of the fit hold; {found.covered.coverage}."
    sure = " ".join([*left_far(found), sure])
    step = "Load controller.mat, or the matrices of the JSON, and try it on the rig with the torque limited."
    if not found.helps:
        step = "Do not use it; see below what narrows the envelope."
    return Bullets(said[0], " ".join([sure, *warnings[:1]]), warnings[-1] if warnings else step)


def _parameter(name: str, p: object) -> str:
    value, std, unit = (getattr(p, part) for part in ("value", "std", "unit"))
    return f"{name} {value:.5g} +- {std:.2g}{'' if unit == '1' else f' {unit}'} ({100 * abs(std / value):.2g} %)"


def _after(compared: Compared, file: str, good: str) -> str:
    if largest(compared) > _NOISE:
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
