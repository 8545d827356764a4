"""A law that was read off the missing force, in the place of effects that stand for a part of it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from estimators.core.fit import Fit
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.missing_force import shared_with, static_force
from estimators.diagnosis.model_extension import Added, extended_without, is_sure, misfit
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.misspecification.force_formulas import Formula, formula_text
from estimators.misspecification.static_force import ForceCurve
from estimators.validation.simulation_error import Compared
from rtac_jax.effects import Force
from rtac_jax.measurement import Recording

LAWS = 3
"""Laws of a curve that are worth a fit or a line."""


class ReadLaw(NamedTuple):
    """A law in a model.

    Attributes:
        step: the model with it.
        law: what it is, as a candidate.
        formula: the law as it was read.
        given_up: ids of the effects whose place it takes.
        curve: off which it was read.
        others: laws that describe the same curve.
    """

    step: Added
    law: Candidate
    formula: Formula
    given_up: tuple[str, ...]
    curve: ForceCurve
    others: tuple[Formula, ...] = ()

    def among(self, added: Sequence[Candidate]) -> list[Candidate]:
        """Return what was added with the law in the place of what it takes."""
        return [*(c for c in added if c.id not in self.given_up), self.law]

    def said(self, before: Compared, last: Added) -> str:
        """Return what it is, what became of other effects, and how far the error falls.

        Args:
            before: the model without it, against the held-out experiments.
            last: the model with it and all that was added since.
        """
        place = f"takes the place of {', '.join(self.given_up)}" if self.given_up else "is added"
        beside = shared_with(self.curve.port, self.curve.variable, last.fit.model)
        both = f" It and {beside} act along the same variable: take neither without the other." if beside else ""
        return (
            f"{_text(last, self.formula)} is a law read off the missing force, in no catalogue, and {place}: the held-out"
            f" experiments were left at {misfit(before):.3g} times the noise, and are at {misfit(last.tested):.3g}.{both}"
        )


def read_law(
    last: Added,
    added: Sequence[Candidate],
    curve: ForceCurve,
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy,
    progress: bool,
) -> ReadLaw | None:
    """Return the law of a curve that leaves least of the held-out error, if that clearly falls; None where none does.

    It takes the place of all forces on the same part that were added: the nearest effect of a catalogue takes the best part of a
    law that is in none, and what is then missing makes up for what that effect gets wrong. Where no law in that place follows to
    the noise, laws stand beside those forces, too: a cubic spring is the first term of a spring that hardens otherwise. What is
    missing beside the law shows when the model is diagnosed again.

    Args:
        last: the model that fails.
        added: the effects that were added.
        curve: the missing force, as the diagnosis of that model has it.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds.
        progress: show bars.
    """
    if curve.evidence is None:
        return None
    given_up = tuple(c.id for c in added if _is_force_on(last, c.id, curve.port))
    formulas = curve.formulas(most=LAWS)

    def best(instead_of: tuple[str, ...]) -> ReadLaw | None:
        beside = [effect for effect in given_up if effect not in instead_of]
        fitted = _fitted(last, added, curve, formulas, instead_of, train, held_out, progress=progress)
        sure = [law for law in fitted if all(is_sure(law.step.fit, effect) for effect in beside)]
        return min(sure, key=lambda law: misfit(law.step.tested), default=None)

    law = best(given_up)
    if given_up and (law is None or not _follows(law)):
        other = best(())
        if other is not None and (law is None or _falls(law.step, other.step, policy)):
            law = other
    return law if law is not None and _falls(last, law.step, policy) else None


def _fitted(
    last: Added,
    added: Sequence[Candidate],
    curve: ForceCurve,
    formulas: Sequence[Formula],
    given_up: tuple[str, ...],
    train: Recording,
    held_out: Recording,
    *,
    progress: bool,
) -> list[ReadLaw]:
    """Return the model with each of several laws in the place of effects, by id, where a fit tells the law from nothing."""
    kept = [c.id for c in added if c.id not in given_up]
    found: list[ReadLaw] = []
    for formula in (one for one in formulas if one.effect.id not in last.fit.model):
        label = "+ " + ", ".join([*kept, formula.effect.id])
        step = extended_without(last, given_up, [formula.effect], label, train, held_out, progress=progress)
        if step is not None and is_sure(step.fit, formula.effect.id):
            others = tuple(one for one in formulas if one is not formula)
            found.append(ReadLaw(step, _candidate(formula, curve), formula, given_up, curve, others))
    return found


def _falls(before: Added, after: Added, policy: DiagnosisPolicy) -> bool:
    return misfit(after.tested) <= (1 - policy.fall) * misfit(before.tested)


def other_law(
    read: ReadLaw,
    last: Added,
    added: Sequence[Candidate],
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy,
    progress: bool,
) -> ReadLaw | None:
    """Return another law of the same curve that does clearly better beside what was added since; None where none does.

    Beside a model that lacks something else as well several laws may do equally badly.

    Args:
        read: the law in the model.
        last: the model, with all that was added.
        added: these effects, and the law.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds.
        progress: show bars.
    """
    fitted = _fitted(last, added, read.curve, read.others, (read.law.id,), train, held_out, progress=progress)
    best = min(fitted, key=lambda law: misfit(law.step.tested), default=None)
    return best if best is not None and _falls(last, best.step, policy) else None


def simpler_law(
    last: Added,
    added: Sequence[Candidate],
    diagnoses: Sequence[Diagnosis],
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy,
    progress: bool,
) -> ReadLaw | None:
    """Return a law with fewer parameters than a force that was added, which is likelier in its place; None where none is.

    The corner of an end stop takes the place of a spring that hardens smoothly where the data hardly show it. The held-out error
    must not rise with the law.

    Args:
        last: the model that is adequate.
        added: the effects that were added.
        diagnoses: that named them.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds.
        progress: show bars.
    """
    found: list[ReadLaw] = []
    for named in diagnoses:
        curve, _ = static_force(named.curves, named.tests, policy)
        ids = {c.id for c in named.effects} & {c.id for c in added}
        forces = (
            [] if curve is None or curve.evidence is None else [i for i in ids if _is_force_on(last, i, curve.port)]
        )
        if curve is None or len(forces) != 1:
            continue
        free = sum(name.startswith(f"{forces[0]}.") for name in last.fit.model.free)
        fewer = [one for one in (curve.formulas(most=LAWS) if free > 1 else ()) if len(one.parameters) < free]
        found += _fitted(last, added, curve, fewer, (forces[0],), train, held_out, progress=progress)
    best = min(found, key=lambda one: _bic(one.step.fit), default=None)
    if best is None or misfit(best.step.tested) > misfit(last.tested):
        return None
    return best if _bic(last.fit) - _bic(best.step.fit) > policy.bic_gain else None


def _bic(fit: Fit) -> float:
    return math.inf if fit.criteria is None else fit.criteria.bic


def _follows(one: ReadLaw) -> bool:
    return all(at_noise(e.rms_over_noise) for e in one.step.tested.errors.values())


def _is_force_on(last: Added, effect: str, port: str) -> bool:
    one = next(e for e in last.fit.model.effects if e.id == effect)
    return isinstance(one, Force) and one.port == port


def _text(step: Added, formula: Formula) -> str:
    names = formula.parameters
    fitted = {name: step.fit.parameters[f"{formula.effect.id}.{name}"] for name in names}
    return formula_text(type(formula.effect), fitted)


def _candidate(formula: Formula, curve: ForceCurve) -> Candidate:
    return Candidate(
        formula.effect.id, float(curve.score), float(curve.explains), float(curve.p_value), detection_limit=math.nan,
        unit=formula.parameters["coefficient_1"].unit, testable=True, refitted=True, held_out_gain=formula.held_out,
        error_reduction=formula.explained, parameters=formula.parameters,
    )  # fmt: skip
