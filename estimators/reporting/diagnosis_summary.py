"""The three bullets that a report of a diagnosis, or of a loop, begins with; of a table of sayings the first that holds is told."""

import dataclasses
import math
import shlex
from collections.abc import Mapping, Sequence

from estimators.core.fit import FAR, Parameter
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.reporting.html import Bullets
from estimators.reporting.largest_error import largest, largest_error
from estimators.validation.simulation_error import Compared, Comparison

_USE = "Use the model: a controller (rtac envelope, rtac control), given recordings of several conditions."
_WITH_IT = "Use the model with it, in the range of motion that was recorded."
_AS_FAR = (
    "Use the model as far as its held-out error is good enough; what else is missing shows where the force below acts."
)
_BY_PREDICTIONS = (
    "Take the parameters from predictions (est.prediction_error_nonlinear): no simulation follows the rig. A record at rest and a "
    "repeat tell random forces from what is missing."
)
_MORE_TIME = "Give more time (--within), or a part of the recording: not all was fitted before the time was over."
_SEPARATE = (
    "Record the experiment that tells them apart, if one could be planned (next_experiment.h5), join it, and diagnose again; else "
    "measure by itself what they stand for."
)
_SETTLE = "Let the rig run before it is recorded, or fit shorter experiments and hold them against each other."
_LOOK = "Look where and at which frequency the force acts (below), and give an effect of your own with --effects."


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
    told = _Told.of(found, estimates)
    before, after = ((tested or trained).models[n] for n in (0, -1))
    sure = _sure(told, before, after, held_out=tested is not None)
    far = largest(after) > FAR
    return Bullets(f"{_found(told)}.", f"{sure[0].upper()}{sure[1:]}.", _next(told, file, doubts, far=far))


@dataclasses.dataclass(frozen=True)
class _Told:
    """The facts of a diagnosis, or of a loop, that the bullets ask for.

    Attributes:
        verdict: of it.
        last: the diagnosis, or the last one.
        loop: None for a diagnosis.
        effects: that were added, or else named.
        final: values to tell of them.
    """

    verdict: str
    last: Diagnosis
    loop: Improvement | None
    effects: tuple[Candidate, ...]
    final: Mapping[str, Parameter]

    @classmethod
    def of(cls, found: Diagnosis | Improvement, estimates: Mapping[str, Parameter] | None) -> "_Told":
        if isinstance(found, Diagnosis):
            return cls(found.verdict, found, None, found.effects, estimates or {})
        # What a model holds after all else was fitted beside it; a diagnosis estimates before that.
        final = estimates or found.final.parameters
        return cls(found.verdict, found.diagnoses[-1], found, found.added or found.diagnoses[0].effects, final)

    @property
    def named(self) -> str:
        return "; ".join(self.effect(c) for c in self.effects)

    def effect(self, candidate: Candidate) -> str:
        """Return the id of an effect with its parameters."""
        inside = ", ".join(
            f"{name} {p.value:.4g}{f' +- {p.std:.2g}' if math.isfinite(p.std) and p.std else ''} {p.unit}".removesuffix(
                " 1"
            )
            for name, p in ((n, self.final.get(f"{candidate.id}.{n}", p)) for n, p in candidate.parameters.items())
        )
        return f"{candidate.id}{f' ({inside})' if inside else ''}"

    @property
    def added(self) -> bool:
        return self.loop is not None and bool(self.loop.added)

    @property
    def late(self) -> bool:
        return self.loop is not None and bool(self.loop.not_added) and not self.added

    @property
    def varying(self) -> tuple[str, ...]:
        """Return the parameters that differ between experiments; empty where none do."""
        differing = None if self.loop is None else self.loop.constancy
        return differing.varying if differing is not None and differing.decisive else ()

    @property
    def outlying(self) -> str:
        """Return the experiment that alone differs from all others; empty where none does."""
        differing = None if self.loop is None else self.loop.constancy
        one = None if differing is None else differing.outlying
        return one.name if one is not None and one.decisive else ""


def _found(told: _Told) -> str:
    """Return what was found: of the effects, of a last resort, and of experiments that differ."""
    loop, last, named = told.loop, told.last, told.named
    in_time = ", as far as was asked before the time was over" if last.broken_off else ""
    way = f"; added on the way: {named}" if named else ""
    if named and loop is not None and not told.added:
        way = f"; what a diagnosis names, {named}, does not serve held-out experiments and was not added"
    alike = "; ".join(f"{c.id} from {', '.join(c.confusable_with)}" for c in told.effects if c.confusable_with)
    inside = f"Was missing, and is in the model now: {named}"
    verdict, whole = told.verdict, loop is not None and bool(named)
    said = _first(
        (
            loop is not None and loop.names_nothing_sure,
            f"What is missing is not known: {named} was named, and the last fit does not tell it from nothing",
        ),
        (told.late, f"The model fails; missing, and not added before the time was over: {named}"),
        (verdict == "adequate" and whole, f"{inside}; nothing more is missing {last.floor}{in_time}"),
        (verdict == "adequate", f"Nothing is missing from the model {last.floor}{in_time}"),
        (verdict == "missing" and whole, inside),
        (verdict == "missing", f"Missing: {named}" if named else "An effect is missing"),
        (
            verdict == "ambiguous" and told.added,
            f"{inside}. But these data cannot tell {alike}, which may be it as well",
        ),
        (verdict == "ambiguous", f"One of a group is missing, and these data cannot tell which: {named}"),
        (bool(last.silent), last.silent),
        (bool(last.drift), f"The model fails as where a parameter drifts{way}: {last.drift}"),
        (bool(last.line_alone), f"Only a line speaks against the model{way}: {last.line_alone}"),
        (bool(last.rounding), f"What speaks against the model may be rounding{way}: {last.rounding}"),
        (
            last.slight,
            f"The simulation is left at {last.simulated:.2f} times the noise, though tests of predictions reject the model, and "
            f"{last.no_effect} explains why{way}",
        ),
        (True, f"The model fails, and {last.no_effect} explains it{way}"),
    )
    if loop is not None and loop.learned is not None:
        said += (
            f". As a last resort a learned force was added, which is no physical effect: on the {loop.learned.port} against "
            f"{loop.learned.variable.replace('_', ' ')}"
        )
    if loop is not None and loop.nearest is not None:
        said += (
            f". As a last resort the nearest, {told.effect(loop.nearest)}, was added, which explains "
            f"{100 * loop.nearest.error_reduction:.0f} % of what was left: likely, not certain"
        )
    differ = "differs" if len(told.varying) == 1 else "differ"
    said += f"; {' and '.join(told.varying)} {differ} between experiments" if told.varying else ""
    if told.outlying:
        said += f"; {told.outlying} alone differs from all other experiments"
        said += ", and the last model is fitted without it" if loop is not None and loop.left_out is not None else ""
    return said


def _sure(told: _Told, before: Compared, after: Compared, *, held_out: bool) -> str:
    """Return how sure that is: the error before and after, what speaks for the effects, and what they are confused with."""
    sure = largest_error(before, held_out)
    if before is not after:
        ratio = {c: (e.rms_over_noise, after.errors[c].rms_over_noise) for c, e in before.errors.items()}
        falls = ", ".join(f"{channel.replace('_', ' ')} {a:.3g} to {b:.3g}" for channel, (a, b) in ratio.items())
        kind = "experiments that no fit has seen" if held_out else "the fitted experiments"
        sure = f"error over noise on {kind}: {falls}"
    gained = [f"{c.id} by a BIC gain of {c.bic_gain:,.0f}" for c in told.effects if c.bic_gain > 0]
    rivals = sorted({name for c in told.effects for name in c.confusable_with})
    sure += f"; {' and '.join(gained)}" if gained else ""
    return sure + (f"; confusable with {', '.join(rivals)}" if rivals else "")


def _next(told: _Told, file: str, doubts: Sequence[str], *, far: bool) -> str:
    """Return what to do next: what is doubtful first, then the experiment that differs, then the model."""
    if doubts and told.last.verdict == "unknown":
        return f"Mend the recording first, or leave out what is wrong, and ask again. {doubts[0]}"
    if not told.outlying:
        return _with_model(told, file, far=far)
    without = told.loop is not None and told.loop.left_out is not None
    after_that = "The last model follows the others." if without else _with_model(told, file, far=far)
    return (
        f"Look at {told.outlying}: its sample time, lost samples or counts, a sensor that was set anew, what touched the rig, or "
        f"what it alone shows; then again without it. {after_that}"
    )


def _with_model(told: _Told, file: str, *, far: bool) -> str:
    """Return what to do with the model; `far` where its simulation follows the rig no longer."""
    loop, last, verdict = told.loop, told.last, told.verdict
    mended = loop is not None and loop.mended == "adequate"
    fails = told.added and not mended and not last.line_alone
    learned = None if loop is None else loop.learned
    names = ", ".join(map(repr, told.varying))
    values, what = ("a value", "it") if len(told.varying) == 1 else ("values", "them")
    own = f"Give each experiment {values} of its own (model.each_experiment({names})), or let settle what moves {what}."
    return _first(
        (
            learned is not None,
            "" if learned is None else _within(learned.between, learned.variable, learned.variable_unit),
        ),
        (loop is not None and loop.nearest is not None, _AS_FAR),
        (told.late, _MORE_TIME),
        (verdict == "adequate", _BY_PREDICTIONS if far and not mended else _USE),
        (verdict == "missing" and far and mended, _BY_PREDICTIONS),
        (verdict == "missing" and fails, _AS_FAR),
        (
            verdict == "missing",
            f"rtac improve {shlex.quote(file)}, which adds it and goes on." if loop is None else _WITH_IT,
        ),
        (verdict == "ambiguous", _SEPARATE),
        (bool(last.silent), last.silent_mend),
        (bool(last.drift), _SETTLE),
        (bool(told.varying), own),
        (loop is not None and loop.broken_off, _MORE_TIME),
        (bool(last.likely_drift), _SETTLE),
        (True, _LOOK),
    )


def _within(between: tuple[float, float], variable: str, unit: str) -> str:
    low, high = between
    return (
        f"Use the model between {low:.3g} and {high:.3g} {unit} of {variable.replace('_', ' ')} only, where the force was learned; "
        "try one of the laws below, or an effect of your own with --effects."
    )


def _first(*rows: tuple[bool, str]) -> str:
    return next(said for holds, said in rows if holds)
