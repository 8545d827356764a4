"""Tests of adequacy: every test that the innovations of a predictor must pass, each with its p-value."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from estimators.misspecification.findings import CriticalValues, Findings, ParameterDrift, Scored


@runtime_checkable
class _Force(Protocol):
    @property
    def p_value(self) -> float: ...

    @property
    def excess(self) -> float: ...


Candidate = TypeVar("Candidate", bound=Scored)
Missing = TypeVar("Missing", bound=_Force)


@dataclasses.dataclass(frozen=True)
class AdequacyTest:
    """The result of one test of whether anything is missing.

    Attributes:
        test: "repeats", "named effects", "static force", "delayed force", "drift" or "spectral line".
        p_value: by chance, with everything counted that the test tried.
        excess: what the test finds beyond chance, in units of twice the log-likelihood; repeats give a ratio instead.
        level: p-value below which it rejects.
        words: its statement, for a reader.
        alarmed: whether what the test asks for beside a small p-value is there: of named effects that one of them raises the
            alarm.
    """

    test: str
    p_value: float
    excess: float
    level: float
    words: str
    alarmed: bool = True

    @property
    def rejects(self) -> bool:
        """Return whether it says that something is missing."""
        return self.alarmed and self.p_value < self.level


def p_by_chance(one: Scored, tried: int) -> float:
    """Return the probability of so large a statistic for any of the candidates that were tried."""
    return min(1.0, tried * one.p_value)


def alarming(screened: Sequence[Candidate], critical: CriticalValues) -> list[Candidate]:
    """Return the candidates that the innovations speak for, whatever the colour of the noise: rejections of absence."""
    return [s for s in screened if s.statistic >= critical.alarm and p_by_chance(s, len(screened)) < critical.chance]


def overshadowing(screened: Sequence[Candidate], critical: CriticalValues) -> list[Candidate]:
    """Return candidates that reject in no shape, and are larger than all that do.

    What is large at few instants scatters over stretches of time as much as it shows. Once something rejects, what
    would explain more than all that does is not passed over for it.
    """
    alarms = alarming(screened, critical)
    ids = {s.id for s in alarms}
    largest = max((s.statistic for s in alarms), default=np.inf)
    return [s for s in screened if s.id not in ids and s.statistic > largest]


def suspects(screened: Sequence[Candidate], tests: Sequence[AdequacyTest], critical: CriticalValues) -> list[Candidate]:
    """Return the candidates to refit where none rejects and another test does: all that reach the critical size.

    What acts at a few instants, as a stop that is hit once, scatters over stretches of time as much as it shows.
    """
    if alarming(screened, critical) or not rejecting(tests):
        return []
    return [s for s in screened if s.statistic >= critical.alarm]


def few_for(s: Scored, stretches: int, tried: int, critical: CriticalValues) -> bool:
    """Return whether a candidate is large by the model's variance, and so few stretches of time could not confirm it.

    Two confirm nothing, however large it is.
    """
    return s.statistic >= critical.alarm and (stretches == 2 or s.statistic < critical.of_few(stretches, tried))


def unconfirmed(scores: Sequence[Candidate], stretches: int, critical: CriticalValues) -> list[Candidate]:
    """Return candidates that few stretches of time could not confirm (`few_for`), where none raises an alarm."""
    if alarming(scores, critical):
        return []
    return [s for s in scores if few_for(s, stretches, len(scores), critical)]


def adequacy_tests(found: Findings, critical: CriticalValues) -> tuple[AdequacyTest, ...]:
    """Return all tests, in the order in which a reader asks; those without data are left out."""
    screened, curves, delayed, line, repeats = found.scores, found.curves, found.lagged, found.line, found.repeats
    asked = sum(bool(known) for known in (screened, curves, delayed, found.drifts, line, repeats))
    level = critical.level / max(asked, 1)
    tests = []
    if repeats is not None:
        words = f"what the {repeats.repeats} repeats share is {repeats.ratio:.2f} times what noise alone would leave"
        tests.append(AdequacyTest("repeats", repeats.p_value, 0.0, level, words))
    if screened:
        alarms = alarming(screened, critical)
        best = max(alarms or screened, key=lambda s: s.statistic)
        words = f"{best.id} reaches {best.statistic:.0f}, the alarm is at {critical.alarm:.0f}{_scattered(best, alarms, critical)}"
        excess = best.statistic - len(best.amplitudes)
        p_value = p_by_chance(best, len(screened))
        tests.append(AdequacyTest("named effects", p_value, excess, level, words, alarmed=bool(alarms)))
    if curves:
        p_value, curve = _strongest(curves, level)
        words = f"a force on the {curve.port} that depends on {curve.variable} would explain {curve.excess:.0f}"
        tests.append(AdequacyTest("static force", p_value, curve.excess, level, words))
    if delayed:
        p_value, one = _strongest(delayed, level)
        words = f"a force on the {one.port} that follows {one.follows} with a lag would explain {one.excess:.0f}"
        tests.append(AdequacyTest("delayed force", p_value, one.excess, level, words))
    if found.drifts:
        p_value, drift = _strongest(found.drifts, level)
        words = f"{drift.parameter} that changes {_rate(drift)} within experiments would explain {drift.excess:.0f}"
        others = [d for d in significant(found.drifts, level) if d is not drift]
        by_themselves = ", ".join(f"{d.parameter} {d.excess:.0f}" for d in others)
        words += f" (others by themselves: {by_themselves})" if others else ""
        tests.append(AdequacyTest("drift", p_value, drift.excess, level, words))
    if line is not None:
        where = f"{line.channel} at {line.frequency:.3g} rad/s ({line.in_hertz})"
        words = f"the strongest line, of {where}, has {line.ratio:.1f} times the power around it"
        tests.append(AdequacyTest("spectral line", line.p_value, line.excess, level, words))
    return tuple(tests)


def _rate(drift: ParameterDrift) -> str:
    """Return how fast a parameter changes: in percent of its value, or where it is small beside that in its unit."""
    if abs(drift.rate) < abs(drift.value):  # in a second
        return f"by {100 * drift.rate / abs(drift.value):+.3g} +- {100 * drift.std / abs(drift.value):.2g} % a second"
    unit = "" if drift.unit == "1" else f" {drift.unit}"
    return f"by {drift.rate:+.3g} +- {drift.std:.2g}{unit} a second"


def _scattered(best: Scored, alarms: Sequence[Scored], critical: CriticalValues) -> str:
    """Return why a candidate as large as the alarm raises none; nothing where one does, or none is so large."""
    if alarms or best.statistic < critical.alarm:
        return ""
    return f", but it scatters over the seconds of data so that by itself it has p = {best.p_value:.2g}"


def significant(several: Sequence[Missing], level: float) -> list[Missing]:
    """Return those of several forces that explain more than chance does, all of them counted."""
    return [one for one in several if one.p_value * len(several) < level]


def _strongest(several: Sequence[Missing], level: float) -> tuple[float, Missing]:
    """Return the joint p-value of several forces, and of the significant ones the one that explains most."""
    surest = min(several, key=lambda one: (one.p_value, -one.excess))
    strongest = max(significant(several, level), key=lambda one: one.excess, default=surest)
    return min(1.0, surest.p_value * len(several)), strongest


def rejecting(tests: Sequence[AdequacyTest]) -> list[AdequacyTest]:
    """Return the tests that reject."""
    return [test for test in tests if test.rejects]


def excess_of(tests: Sequence[AdequacyTest]) -> float:
    """Return the most that any test finds beyond chance which rejects; zero where none does."""
    return max((test.excess for test in rejecting(tests)), default=0.0)
