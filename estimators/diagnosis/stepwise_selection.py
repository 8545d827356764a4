"""Stepwise selection of effects that improve a model, and second looks where these leave the misfit unknown."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from estimators.diagnosis.candidate import Step
from estimators.diagnosis.choice import chosen, reconsidered
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.refitting import Search, Way
from estimators.diagnosis.verdict import judge
from estimators.misspecification.adequacy import alarming, excess_of, line_left, overshadowing, suspects
from estimators.misspecification.candidate_screening import ALARM, Screened
from rtac_jax.effects import Effect

Tried = dict[str, tuple[Refit, Refit]]
"""Of every candidate that was tried the model before and after."""


@dataclasses.dataclass(frozen=True)
class _Look:
    """The candidates of a first step, rejecting or not, in the order of how strongly they are suspected.

    Attributes:
        ranked: those to be refitted, all but the first and what is near it only if the first leaves something.
        near: those among them that are refitted together with the first.
        way: to refit them.
    """

    ranked: Sequence[Screened]
    near: Sequence[Screened]
    way: Way


def _statistic(s: Screened) -> float:
    return s.statistic


def _consistency(s: Screened) -> float:
    return -float(np.log(max(s.p_value, 1e-300)))


def _near(ranked: Sequence[Screened], strength: Callable[[Screened], float], close: float) -> list[Screened]:
    return [s for s in ranked[1:] if strength(s) > (1 - close) * strength(ranked[0])]


def _unalarmed(search: Search, base: Refit, tested: Tested) -> _Look:
    """Return candidates that are large, but act at a few instants only."""
    found = by_size(suspects(tested.screened, tested.tests), float(np.log(search.samples)))[: search.policy.refits]
    return _Look(found, _near(found, _statistic, search.policy.close), search.with_effect)


def _hidden(search: Search, base: Refit, tested: Tested) -> _Look:
    """Return candidates that random forces of the predictor may hide.

    Where the innovations are far from white, what is alike in every second tells more than what is large. And where the most that
    is left is a line of the spectrum that neither input nor state explains, something rings: what has a resonance comes first, and
    is held against those that would come first otherwise.
    """
    large = by_size(search.quietly(base), float(np.log(search.samples)))
    alike = sorted(large, key=_consistency, reverse=True)
    together = [*alike[:1], *_near(alike[: search.policy.hidden], _consistency, search.policy.close)]
    if 0 < line_left(tested.tests) == excess_of(tested.tests):
        together = [*(s for s in alike if _rings(search.classes[s.id]) and s.statistic > ALARM), *together]
    # What works by contact shows nowhere until the filter follows it.
    contacts = [s for s in large if search.classes[s.id].acts_by_contact]
    ranked = list(
        {
            s.id: s for s in (*together, *alike[: search.policy.hidden], *large[: search.policy.hidden], *contacts)
        }.values()
    )
    names = {s.id for s in together}
    return _Look(ranked, [s for s in ranked[1:] if s.id in names], search.thoroughly)


def _rings(effect: type[Effect]) -> bool:
    """Return whether an effect has a resonance: two states of its own, which are not those of a play."""
    return len(effect.states) > 1 and not effect.acts_by_contact


def second_looks(
    search: Search, base: Refit, tested: Tested, steps: list[Step], refits: Tried
) -> tuple[list[Step], Tried]:
    """Return the steps or, where these leave the misfit unknown, others that explain it; and all that was tried."""
    if judge(steps, tested.tests, search.samples, search.policy)[0] != "unknown":
        return steps, refits
    for look in (_unalarmed, _hidden):
        search.bar.set_description("diagnose: what raised no alarm")
        again, more = improvements(search, base, tested, look(search, base, tested))
        refits = more | refits
        named = judge(again, tested.tests, search.samples, search.policy)[1]
        # A mode without damping can follow a vibration from outside, but for the line that this leaves.
        if named and line_left(again[named - 1].left) <= search.policy.line_left * again[0].gain:
            return again, refits | more
    return steps, refits


def improvements(search: Search, base: Refit, tested: Tested, look: _Look | None = None) -> tuple[list[Step], Tried]:
    """Select effects that improve the model one after the other; return them and what was tried.

    The candidates of every step are those that reject, and those that overshadow them; of the first, those of a look.
    """
    steps: list[Step] = []
    refits: Tried = {}
    now, seen = base, tested
    price = float(np.log(search.samples))
    for _ in range(2 * search.policy.effects):  # a step may be taken back
        if look is not None and not steps:
            way, ranked, near, above = look.way, look.ranked, look.near, []
        else:
            way, ranked = None, by_size(alarming(seen.screened), price)
            near = _near(ranked, _statistic, search.policy.close)
            above = by_size(overshadowing(seen.screened), price)[: search.policy.refits]
        if not ranked:
            break
        several, ahead = search.first_refits(now, ranked[0], near, way)
        begun = {s.id for s in (ranked[0], *near)}
        # Where the best leaves nothing to explain, those far behind it need not be asked.
        settled = ahead is not None and not any(test.rejects for test in ahead.tests)
        most = len(ranked) if way else search.policy.refits
        far = [] if settled else [*(s for s in ranked[1:most] if s.id not in begun), *above]
        several |= search.refits(now, far, way)
        asked = {s.id: s for s in (*ranked, *above)}
        tried = {i: (asked[i], refit) for i, refit in several.items()}
        for i, (_, refit) in tried.items():
            refits.setdefault(i, (now, refit))
        search.bar.set_description("diagnose: what is left")
        while (step := chosen(search, now, tried)) is not None:
            seen = ahead if ahead is not None and step.id == ranked[0].id else search.tested(step.refit)
            if not any(s.id == step.id for s in above) or line_left(seen.tests) <= search.policy.line_left * step.gain:
                break
            del tried[step.id]
        if step is None:
            break
        steps = [*steps, dataclasses.replace(step, left=seen.tests, way=way)]
        # Where some are named and the next cannot be, the rest is left to the next diagnosis, with those in the model.
        if 0 < judge(steps, tested.tests, search.samples, search.policy)[1] < len(steps):
            refits[step.id] = (now, step.refit)
            break
        steps = reconsidered(search, base, steps)
        if steps[-1].refit is not step.refit:
            seen = search.tested(steps[-1].refit)
            steps[-1] = dataclasses.replace(steps[-1], left=seen.tests)
        befores = [base, *(s.refit for s in steps)]
        refits |= {s.id: (before, s.refit) for s, before in zip(steps, befores, strict=False)}
        now = steps[-1].refit
        count = judge(steps, tested.tests, search.samples, search.policy)[1]
        if (
            len(steps) == search.policy.effects
            or not any(test.rejects for test in seen.tests)
            or 0 < count < len(steps)
        ):
            break
    return steps, refits


def by_size(screened: Sequence[Screened], price: float) -> list[Screened]:
    """Return the best shape of every effect, by what it explains less the price of its amplitudes."""
    best: dict[str, Screened] = {}
    for s in screened:
        if s.id not in best or s.statistic > best[s.id].statistic:
            best[s.id] = s
    return sorted(best.values(), key=lambda s: -(s.statistic - len(s.amplitudes) * price))
