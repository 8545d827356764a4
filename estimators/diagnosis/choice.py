"""Choice among several refits, and the same once more when all effects are in the model."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from estimators.diagnosis.candidate import Step
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import Search
from estimators.misspecification.candidate_screening import Screened
from estimators.validation.model_comparison import vuong


def gain(before: Refit, after: Refit) -> float:
    """Return the gain in log-likelihood."""
    return after.predictor.log_likelihood - before.predictor.log_likelihood


def bic_gain(search: Search, before: Refit, after: Refit) -> float:
    """Return twice the gain in log-likelihood less the price of the parameters added."""
    return 2 * gain(before, after) - (len(after.free) - len(before.free)) * float(np.log(search.samples))


def chosen(search: Search, before: Refit, tried: Mapping[str, tuple[Screened, Refit]]) -> Step | None:
    """Return the best of the refits as the next step; None if none improves the model."""
    refits = {i: refit for i, (_, refit) in tried.items()}
    gains = {i: bic_gain(search, before, refit) for i, refit in refits.items()}
    held_out = {i: search.held_out_gain(before, refit) for i, refit in refits.items()}
    good = [i for i in refits if gains[i] > search.policy.bic_gain and not held_out[i] <= 0]
    if not good:
        return None
    # One whose shape has run away stands in for a simpler one; the user's own fit would refuse it.
    good = [i for i in good if not search.loose(i, refits[i])] or good
    best = max(good, key=lambda i: gains[i])
    rivals = tuple(i for i in good if i != best and _untold(search, before, refits, gains, best, i))
    asked = {i: tried[i][0] for i in sorted(gains, key=lambda i: -gains[i])[: search.policy.reconsidered]}
    return Step(best, rivals, 2 * gain(before, refits[best]), gains[best], held_out[best], refits[best], (), asked)


def _untold(
    search: Search, before: Refit, tried: Mapping[str, Refit], gains: Mapping[str, float], best: str, other: str
) -> bool:
    """Return whether the data cannot tell a candidate from the best."""
    if best in search.classes[other].contains:
        more = len(tried[other].free) - len(tried[best].free)
        return 2 * gain(tried[best], tried[other]) > float(chi2.isf(search.policy.nested_level, max(more, 1)))
    if gains[best] - gains[other] < search.policy.bic_gain:
        return True
    if gain(before, tried[other]) < search.policy.rival * gain(before, tried[best]):
        return False
    price = 0.5 * (len(tried[best].free) - len(tried[other].free)) * float(np.log(search.samples))
    return bool(vuong(tried[best].by_sample, tried[other].by_sample, search.stretches(), price) < search.policy.vuong)


def reconsidered(search: Search, base: Refit, steps: list[Step]) -> list[Step]:
    """Compare every earlier effect with those refitted beside it, now that the later ones are there; return the steps.

    What improves a model most while another effect is missing may only mend what that one does. An effect that is not needed
    any more goes, and one that another replaces better goes for it; rivals are those that the data cannot tell from it now.

    Source: stepwise selection with replacement, as in Miller, Subset Selection in Regression (2002), section 3.
    """
    for effect in [step.id for step in steps[:-1]]:
        # What the model diverges without is needed.
        with contextlib.suppress(ArithmeticError):
            steps = _once_more(search, base, steps, effect)
    return steps


def _once_more(search: Search, base: Refit, steps: list[Step], effect: str) -> list[Step]:
    """Return the steps with one earlier effect compared with those that were refitted beside it."""
    place = next(i for i, step in enumerate(steps) if step.id == effect)
    if place == len(steps) - 1:
        return steps
    step, now = steps[place], steps[-1].refit
    others = [s for i, s in step.asked.items() if i not in now.added]
    search.bar.set_description(f"diagnose: {effect} once more")
    before = search.without(now, effect)
    tried = {effect: (step.asked[effect], now)}
    refits = search.refits(before, others, step.way)
    tried |= {s.id: (s, refits[s.id]) for s in others if s.id in refits}
    winner = chosen(search, before, tried)
    if winner is not None and winner.id == effect:
        return [*steps[:place], dataclasses.replace(step, rivals=winner.rivals), *steps[place + 1 :]]
    return _rebuilt(search, base, steps, place, before) + ([] if winner is None else [winner])


def _rebuilt(search: Search, base: Refit, steps: Sequence[Step], place: int, last: Refit) -> list[Step]:
    """Return the steps without one of them, the refit with all the others being known."""
    found = list(steps[:place])
    fits = {steps[-1].id: last}
    for step, later in zip(reversed(steps[place + 1 : -1]), reversed(steps[place + 2 :]), strict=True):
        fits[step.id] = search.without(fits[later.id], later.id)
    for step in steps[place + 1 :]:
        before = found[-1].refit if found else base
        refit = fits[step.id]
        found.append(
            dataclasses.replace(
                step,
                gain=2 * gain(before, refit),
                bic_gain=bic_gain(search, before, refit),
                held_out_gain=search.held_out_gain(before, refit),
                refit=refit,
                left=search.tested(refit).tests,
            )
        )
    return found
