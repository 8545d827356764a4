"""Which rules of the verdict earn their place: each is switched off over saved evidence, and the verdicts that change are counted.

    python benchmarks/study_diagnosis.py run --evidence DIR --first 96 --draws 2
    python benchmarks/study_diagnosis.py run --evidence HARD --first 110 --draws 2 --kinds short mistaken gross bristles
    python benchmarks/ablate_policy.py DIR HARD
    python benchmarks/ablate_policy.py DIR HARD --verdicts     # every recording with its verdict, and what changes it

Folders of other protocols below DIR are judged with it.

A verdict is better or worse than before against what the rig hides: the right name is best, then it among rivals, more
than it or a part of it, "unknown", "adequate", and last a wrong name. Evidence holds the refits that the standard policy
asked for; "incomplete" counts the recordings in which a rule switched off asks for one that was never computed, and the
verdict is what follows from the others. The last rows judge by one currency: the predictive log-likelihood of experiments
held out, with its standard error.
"""

import argparse
import collections
import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from diagnosis_cases import HARD_WORDS, KINDS, kind_of
from diagnosis_evidence import Recorded, evidence_of_protocols, worth_of

from estimators.diagnosis import stepwise_selection, verdict
from estimators.diagnosis.evidence import Evidence, FittedModel
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.verdict import judge
from estimators.misspecification.adequacy import adequacy_tests, excess_of
from estimators.misspecification.findings import Findings

_WORTH = {
    "effects": ("wrong", "adequate", "unknown", "a part", "right and more", "in the group", "right"),
    "outside": ("wrong", "adequate", "unknown"),
    "nothing": ("wrong", "unknown", "adequate"),
    "mistaken": (
        "wrong",
        "adequate",
        "unknown",
    ),  # no effect of the catalogue is a mistake, and nothing is adequate beside one
}
_ORDER = {kind: _WORTH.get(kind, _WORTH["effects"]) for kind in (*KINDS, *HARD_WORDS)}


class Told(NamedTuple):
    """A verdict and what it names."""

    verdict: str
    effects: tuple[str, ...]
    rivals: dict[str, tuple[str, ...]]
    incomplete: bool = False


Judge = Callable[[Evidence], Told]


def by_policy(policy: DiagnosisPolicy = STANDARD) -> Judge:
    """The judgement by a policy."""

    def told(evidence: Evidence) -> Told:
        found = judge(evidence, policy)
        return Told(found.verdict, found.effects, found.rivals, bool(found.incomplete))

    return told


def without_test(name: str) -> Judge:
    """The judgement where one of the five tests was never made."""
    nothing: dict[str, Any] = {name: None if name in ("line", "repeats") else ()}

    def told(evidence: Evidence) -> Told:
        findings = {number: dataclasses.replace(one, **nothing) for number, one in evidence.findings.items()}
        return by_policy()(dataclasses.replace(evidence, findings=findings))

    return told


def with_patch(module: Any, name: str, instead: Any) -> Judge:
    """The judgement with one function of the rules replaced, by one that gets its places and no keywords."""

    def told(evidence: Evidence) -> Told:
        with mock.patch.object(module, name, lambda *given, **_: instead(*given)):
            return by_policy()(evidence)

    return told


def without_look(name: str) -> Judge:
    """The judgement where one of the second looks finds nobody to suspect."""
    look = getattr(stepwise_selection, name)
    return with_patch(stepwise_selection, name, lambda *found: dataclasses.replace(look(*found), ranked=[], near=[]))


def _without_facts(**changed: Any) -> Judge:
    def told(evidence: Evidence) -> Told:
        return by_policy()(dataclasses.replace(evidence, facts=dataclasses.replace(evidence.facts, **changed)))

    return told


def _without_traits(trait: str, value: object) -> Judge:
    def told(evidence: Evidence) -> Told:
        effects = {i: dataclasses.replace(t, **{trait: value}) for i, t in evidence.facts.effects.items()}
        return _without_facts(effects=effects)(evidence)

    return told


_OFF: dict[str, dict[str, float]] = {
    "removed: nearly everything must go, and noise be little of a far simulation (0)": {"removed": 0.0},
    "bic_gain (0)": {"bic_gain": 0.0},
    "refits: candidates refitted at least (1)": {"refits": 1},
    "close: refitted beside the first (0)": {"close": 0.0},
    "effects: named at most (1)": {"effects": 1},
    "alarm (0)": {"alarm": 0.0},
    "chance: scatter over seconds (1)": {"chance": 1.0},
    "known: held-out gain where others know of the effect (0)": {"known": 0.0},
    "held-out gain must be positive (known 1)": {"known": 1.0},
    "consequence: effects must take something off the error, random forces be some (0)": {"consequence": 0.0},
    "simulation_noise: the simulation's error is asked (never)": {"simulation_noise": math.inf},
    "simulation_poor: of a poor simulation (never)": {"simulation_poor": math.inf},
    "random_large: random forces in place of physics (never)": {"random_large": math.inf},
    "level: no test of adequacy rejects (0)": {"level": 0.0},
    "edge: a shape well below a sensor's noise is the simpler law (never)": {"edge": 0.0},
    "confirming: what every experiment confirms (never)": {"confirming": 1_000_000},
}


def rules() -> dict[str, Judge]:
    """The judgement with each rule switched off by itself."""
    known = STANDARD.as_dict()
    found = {
        name: by_policy(dataclasses.replace(STANDARD, **changed))
        for name, changed in _OFF.items()
        if set(changed) <= set(known)
    }
    tests = {"repeats": "repeats", "curves": "static force", "lagged": "delayed force", "line": "spectral line"}
    found |= {f"test: {words}": without_test(name) for name, words in tests.items()}
    found["what overshadows the alarms is tried"] = with_patch(stepwise_selection, "overshadowing", lambda *_: [])
    found["second look: large, but at a few instants"] = without_look("unalarmed")
    found["second look: what random forces may hide"] = without_look("hidden")
    found["second look: what random forces stand for"] = with_patch(
        stepwise_selection, "behind_random_forces", lambda _, selected, __: selected
    )
    found["second look: what experiment after experiment confirms"] = with_patch(
        stepwise_selection, "confirmed", lambda _, selected, __: selected
    )
    found["second look: what simulations say of the large that scatters"] = with_patch(
        stepwise_selection, "what_simulations_say", lambda _, selected, __: selected
    )
    found["what later effects leave nothing of goes"] = with_patch(
        stepwise_selection, "without_superseded", lambda _, __, steps, ___: steps
    )
    found["colour of the noise after the first effect"] = with_patch(stepwise_selection, "_outdone", lambda *_: None)
    found["too few data: a large candidate that follows at last vetoes"] = with_patch(
        verdict, "_is_supported", lambda *_: False
    )
    found["what is named beside a fit that follows nothing must be followed"] = with_patch(
        verdict, "_unfollowing", lambda *_: None
    )
    found["selection by simulation where that is far"] = with_patch(
        stepwise_selection, "selected_by_simulation", lambda *_: None
    )
    found["gross fits are screened by the equations of motion"] = with_patch(
        stepwise_selection, "gross", lambda *_: False
    )
    found["the first effect may be replaced"] = with_patch(
        stepwise_selection, "with_replacement", lambda _, __, steps, *___: list(steps)
    )
    found["testable: what the data cannot show is passed over (never)"] = _without_facts(untestable=())
    found["what is presupposed comes first"] = _without_traits("presupposes", ())
    found["what resembles the first is refitted"] = _without_traits("resembles", ())
    found["a simpler law is preferred to one that contains it"] = _without_traits("contains", ())
    found["contacts are tried however little they show"] = _without_traits("contact", False)
    found["a shape that ran away gives way"] = with_patch(FittedModel, "leaves_free", lambda *_: False)
    found["too few data: a suspect vetoes"] = with_patch(verdict, "unconfirmed", lambda *_: [])
    return found


# -- one currency -----------------------------------------------------------------------------------------------------


def one_currency(times: float) -> Judge:
    """The judgement by the held-out log-likelihood and its standard error alone.

    A refit is taken if the gain in the log-likelihood of experiments held out is more than so many standard errors, by its
    scatter over seconds; what is less than that behind the best is its rival. "Anything" is the strongest force that the
    tests find: what it would still gain has to be less than a tenth of all, or nothing is named; without a gain, it says
    whether anything is missing.

    Args:
        times: standard errors.
    """

    def told(evidence: Evidence) -> Told:
        models = {model.number: model for model in evidence.models}
        now = models[0]
        if evidence.coloured is not None and models[evidence.coloured].log_likelihood > now.log_likelihood + 10:
            now = models[evidence.coloured]
        steps: list[tuple[str, tuple[str, ...], float, FittedModel]] = []
        while len(steps) < STANDARD.effects and (anything(evidence, now) > 0 or not steps):
            after = {
                one.effect: models[one.after]
                for one in evidence.refits
                if one.before == now.number and one.way != "without" and one.after is not None
            }
            gains = {i: held_out(evidence, now, model) for i, model in after.items()}
            good = {i: g for i, g in gains.items() if g > times * error(now, after[i])}
            if not good:
                break
            best = max(good, key=lambda i: good[i])
            rivals = [i for i in good if i != best and good[best] - good[i] < times * error(after[i], after[best])]
            steps.append((best, tuple(rivals), good[best], after[best]))
            now = after[best]
        for count in range(len(steps), 0, -1):
            left = anything(evidence, steps[count - 1][3])
            if left < 0.1 * (left + sum(step[2] for step in steps[:count])):
                rivals = {
                    step[0]: tuple(r for r in step[1] if r not in {s[0] for s in steps[:count]})
                    for step in steps[:count]
                }
                return Told("ambiguous" if any(rivals.values()) else "missing", tuple(rivals), rivals)
        return Told("unknown" if anything(evidence, models[0]) > 0 else "adequate", (), {})

    return told


def anything(evidence: Evidence, model: FittedModel) -> float:
    """Return what the strongest force of unknown origin would gain in the log-likelihood; 0 where no test rejects."""
    tests = adequacy_tests(evidence.findings.get(model.number, Findings()), STANDARD.critical)
    return 0.5 * excess_of(tests)


def held_out(evidence: Evidence, before: FittedModel, after: FittedModel) -> float:
    """The gain in the log-likelihood of experiments held out."""
    found = evidence.held_out.get((before.number, after.number))
    if found is None:
        return -math.inf
    gains = [gain for gain, known in zip(found.gain, found.known, strict=True) if known >= STANDARD.known]
    return sum(gains) if gains else after.log_likelihood - before.log_likelihood


def error(before: FittedModel, after: FittedModel) -> float:
    """The standard error of a gain, by its scatter over seconds."""
    gains = [a - b for a, b in zip(after.by_stretch, before.by_stretch, strict=True)]
    mean = sum(gains) / len(gains)
    return math.sqrt(len(gains) / max(len(gains) - 1, 1) * sum((one - mean) ** 2 for one in gains))


# -- tables -----------------------------------------------------------------------------------------------------------


def worth(of: Recorded, told: Told) -> int:
    """Return how good a verdict is against what the rig hides; more is better."""
    said = worth_of(of.name, *told[:3], protocol=of.protocol)
    order = _ORDER[kind_of(of.name)]
    return order.index(said) if said in order else 0


def ablation(kept: dict[Recorded, Evidence]) -> str:
    """Markdown: of every rule switched off, how many verdicts change, for better or worse."""
    before = {key: by_policy()(one) for key, one in kept.items()}
    lines = [
        f"| switched off ({len(kept)} recordings) | verdicts changed | better | worse | as good | incomplete |",
        "|---|---|---|---|---|---|",
    ]
    several = rules() | {f"one currency, {times:g} standard errors": one_currency(times) for times in (2.0, 3.0)}
    for name, told in several.items():
        counts: collections.Counter[str] = collections.Counter()
        for key, evidence in kept.items():
            now = told(evidence)
            counts["incomplete"] += now.incomplete
            if now[:3] != before[key][:3]:
                counts["changed"] += 1
                counts[["worse", "better", "as good"][_sign(worth(key, now) - worth(key, before[key]))]] += 1
        cells = " | ".join(str(counts[c] or "") for c in ("changed", "better", "worse", "as good", "incomplete"))
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines)


def _sign(difference: int) -> int:
    return 0 if difference < 0 else 1 if difference > 0 else 2


def rates(kept: dict[Recorded, Evidence], told: Judge) -> str:
    """One line a kind of case: how often each outcome came."""
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    for of, evidence in kept.items():
        counts[kind_of(of.name)][worth_of(of.name, *told(evidence)[:3], protocol=of.protocol)] += 1
    return "\n".join(f"{kind}: {dict(several)}" for kind, several in counts.items())


def verdicts(kept: dict[Recorded, Evidence]) -> Iterator[str]:
    """One line a recording: its verdict, and the rules without which it changes."""
    several = rules()
    for of, evidence in kept.items():
        before = by_policy()(evidence)
        said = worth_of(of.name, *before[:3], protocol=of.protocol)
        changing = []
        for rule, told in several.items():
            if (now := told(evidence))[:3] != before[:3]:
                changing.append(f"{rule} ({worth_of(of.name, *now[:3], protocol=of.protocol)})")
        named = f"{before.verdict} {list(before.effects)} {before.rivals}"
        yield f"{of.protocol}, draw {of.draw}, {of.name}: {said}, {named}; changed by: {'; '.join(changing)}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path, nargs="+")
    parser.add_argument("--verdicts", action="store_true", help="list every recording")
    options = parser.parse_args(arguments)
    kept = {key: one for directory in options.directory for key, one in evidence_of_protocols(directory).items()}
    assert kept, f"no evidence in {', '.join(map(str, options.directory))}"
    print(ablation(kept))
    print("\nstandard policy\n" + rates(kept, by_policy()))
    print("\none currency, 2 standard errors\n" + rates(kept, one_currency(2.0)))
    if options.verdicts:
        print("\n" + "\n".join(verdicts(kept)))


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main()
