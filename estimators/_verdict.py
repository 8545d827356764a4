"""What follows from a diagnosis: adequate, missing, ambiguous or unknown, and the same in plain words."""

import math
from collections.abc import Sequence
from typing import Literal

from estimators._adequacy import Evidence, excess_of, removed_by_repeats
from estimators._candidate import Candidate, Step
from estimators._force_curve import ForceCurve
from estimators._latent_force import LatentForce
from estimators._where import Place
from rtac_jax.measurement import Recording

Verdict = Literal["adequate", "missing", "ambiguous", "unknown"]

_FOUND = 0.9  # share of the misfit that the named effects must remove
_STATIC = 0.5  # share of the misfit that a force curve must explain to be called the missing force


def judge(steps: Sequence[Step], tests: Sequence[Evidence], left: Sequence[Evidence]) -> tuple[Verdict, float]:
    """The verdict, and the share of the misfit that the named effects remove.

    The best of a bad set is never named: what the named effects leave must be small beside what they remove.
    """
    if not steps:
        return ("unknown" if any(test.rejects for test in tests) else "adequate"), 0.0
    gained, missing = sum(step.gain for step in steps), excess_of(left)
    removed = min(gained / (gained + missing), removed_by_repeats(tests, left))
    if removed < _FOUND:
        return "unknown", removed
    return ("ambiguous" if any(step.rivals for step in steps) else "missing"), removed


def words(
    verdict: Verdict,
    effects: Sequence[Candidate],
    candidates: Sequence[Candidate],
    steps: Sequence[Step],
    tests: Sequence[Evidence],
    left: Sequence[Evidence],
    removed: float,
    curves: Sequence[ForceCurve],
    latent: Sequence[LatentForce],
    places: Sequence[Place],
) -> str:
    """A paragraph: what is missing, how big, where it shows, how sure, and what would make it surer."""
    if verdict == "adequate":
        limits = sorted((c for c in candidates if c.testable), key=lambda c: c.id)
        text = ", ".join(f"{c.id} {c.detection_limit:.2g} {c.unit}" for c in limits)
        blind = [c.id for c in candidates if not c.testable]
        unseen = f" These data could not show {', '.join(blind)} at any plausible size." if blind else ""
        return f"Adequate: at the noise floor nothing is missing. An effect would have been found from: {text}.{unseen}"
    worst = next((p for p in places if p.by == "experiment"), None)
    part = next((p for p in places if p.by != "experiment" and p.excess > 1), None)
    shown = ""
    if worst is not None:
        shown = f" It shows most in {worst.channel} of {worst.label} ({worst.value:.2f} times the expected squares)"
        shown += f" and at {part.label}." if part is not None else "."
    if verdict == "unknown":
        return _unknown(candidates, tests, removed, curves, latent) + shown
    by_id = {c.id: c for c in effects}
    sentences = []
    for step in steps:
        c = by_id[step.id]
        size = ", ".join(f"{n} = {p.value:.4g} +- {p.std:.2g} {p.unit}" for n, p in c.parameters.items())
        sentences.append(
            f"{step.id} ({size}) gains {step.bic_gain:.0f} in BIC"
            + (
                f" and {step.held_out_gain:.0f} in the log-likelihood of experiments that did not help to estimate it"
                if math.isfinite(step.held_out_gain)
                else ", in one experiment only, so that no other confirms it"
            )
        )
    text = "; ".join(sentences)
    rest = [test.test for test in left if test.rejects]
    after = f"; still, {', '.join(rest)} rejects" if rest else ", and nothing rejects any more"
    share = f" It removes {100 * removed:.0f} % of the misfit{after}."
    if verdict == "missing":
        return f"Missing: {text}.{share}{shown} The intervals do not count that the effect was selected."
    groups = "; ".join(f"{step.id} or {', '.join(step.rivals)}" for step in steps if step.rivals)
    return (
        f"Ambiguous: the data cannot tell {groups} apart. The best fit: {text}.{share}{shown} An experiment that separates "
        "them would decide (est.next_experiment)."
    )


def surer(verdict: Verdict, recording: Recording) -> str:
    """What would make the verdict surer: records that this recording lacks."""
    lacking = []
    if not any(e.kind == "rest" for e in recording.experiments):
        lacking.append("a rest record of two seconds, which tells the noise and its colour apart from the motion")
    if not any(e.repeat_of for e in recording.experiments):
        lacking.append("a repeat of one experiment (repeat_of), which shows model error whatever the noise is")
    if not lacking:
        return ""
    surer = "A missing effect would show more surely" if verdict == "adequate" else "It would be surer"
    return f" {surer} with {', and '.join(lacking)}."


def _unknown(
    candidates: Sequence[Candidate],
    tests: Sequence[Evidence],
    removed: float,
    curves: Sequence[ForceCurve],
    latent: Sequence[LatentForce],
) -> str:
    reasons = "; ".join(f"{test.test}: {test.words}" for test in tests if test.rejects)
    refitted = [c for c in candidates if c.refitted]
    near = max(refitted, key=lambda c: c.error_reduction) if refitted else None
    nearest = f" The nearest, {near.id}, removes {100 * near.error_reduction:.0f} % of the misfit." if near else ""
    if removed and near and removed > near.error_reduction + 0.01:
        nearest += f" Several effects of the catalogue together remove {100 * removed:.0f} %."
    force = f" The missing force is {latent[0]}." if latent else ""
    most = excess_of(tests)
    curve = next((c for c in curves if c.score > 0), None)
    if curve is not None and most > 0 and curve.excess > _STATIC * most:
        static = f" It depends most on {curve.variable} ({curve.port})."
    else:
        static = " It is no static function of position, velocity, angle or current."
    return f"Unknown: the model fails and no effect of the catalogue explains it ({reasons}).{nearest}{force}{static}"
