"""A law that was read off the missing force, in the place of effects that stand for a part of it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.explanation import at_noise
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
        text: the law, with its values and units as the model has them.
        given_up: ids of the effects whose place it takes.
    """

    step: Added
    law: Candidate
    text: str
    given_up: tuple[str, ...]

    def among(self, added: Sequence[Candidate]) -> list[Candidate]:
        """Return what was added with the law in the place of what it takes."""
        return [*(c for c in added if c.id not in self.given_up), self.law]

    def said(self, before: Compared) -> str:
        """Return what it is, what became of other effects, and how far the error falls from that of the model before."""
        place = f"takes the place of {', '.join(self.given_up)}" if self.given_up else "is added"
        return (
            f"{self.text} is a law read off the missing force, in no catalogue, and {place}: the held-out experiments were left at "
            f"{misfit(before):.3g} times the noise, and are at {misfit(self.step.tested):.3g}."
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
    formulas = [one for one in curve.formulas(most=LAWS) if one.effect.id not in last.fit.model]
    found: list[ReadLaw] = []
    for instead_of in dict.fromkeys((given_up, ())):
        if any(_follows(one) for one in found):
            break
        kept = [c.id for c in added if c.id not in instead_of]
        for formula in formulas:
            label = "+ " + ", ".join([*kept, formula.effect.id])
            step = extended_without(last, instead_of, [formula.effect], label, train, held_out, progress=progress)
            if step is not None and is_sure(step.fit, formula.effect.id):
                found.append(ReadLaw(step, _candidate(formula, curve), _text(step, formula), instead_of))
    best = min(found, key=lambda one: misfit(one.step.tested), default=None)
    return best if best is not None and misfit(best.step.tested) <= (1 - policy.fall) * misfit(last.tested) else None


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
