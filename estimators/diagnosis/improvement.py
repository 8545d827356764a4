"""The result of the loop: every model, every diagnosis, and what was found in words."""

import dataclasses
from typing import Any

from estimators.core.drawing import draw
from estimators.core.fit import FAR, Fit
from estimators.core.result_base import Result
from estimators.core.results import RESULTS, STOPPED
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.caveats import (
    astray,
    failure,
    named_too_late,
    not_told_from_nothing,
    of_little_service,
    unsure,
)
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.learned_force import LearnedForce
from estimators.diagnosis.model_extension import PredictedGain, misfit
from estimators.diagnosis.removed_error import Verdict
from estimators.diagnosis.wrong_constant import stands_for
from estimators.linear.homogeneity_test import Equality
from estimators.linear.outlier import rounded
from estimators.output_error.fit_what_shows import values_held
from estimators.prediction_error.fit import PredictorFit
from estimators.validation.simulation_error import Comparison
from rtac_jax.effects.formula_force import FormulaForce
from rtac_jax.measurement import Hum, hum_subtracted
from rtac_jax.overview import Overview
from rtac_jax.renamed import renamed

_MUCH = 10.0  # percent of the motion that are told beside the times of the noise: a fit of 90 % is usually called good
_UNFINISHED = (*STOPPED, RESULTS.pulled_off_bound, RESULTS.undetermined)


@dataclasses.dataclass(frozen=True, repr=False)
class Improvement(Result):
    """The result of `improve`.

    Attributes:
        fits: of the base model and of every model after it, in order; what one diagnosis names is added together. Of more than
            32,000 samples all but the last of those that a part added may be of the part (`diagnosis.loop_on_part`).
        diagnoses: one for every fit that was diagnosed.
        diagnosed: the place of that fit in `fits`.
        added: the effects that were added, in order, as the diagnosis saw them.
        verdict: "adequate" if nothing was missing, "missing" if what was added makes the model adequate or all that can be
            named, else what the last diagnosis says.
        train, validation: every model against the experiments that it was fitted to, and against those held out.
        held: ids of added effects that are held at the estimate of the diagnosis, because a fit by simulation fails, or serves
            held-out experiments worse; deviations of the other parameters count how well the diagnosis knew it.
        predicted: the last model has all its parameters from predictions one sample ahead, because random forces or an arm that
            tumbles carry a simulation away from the data that it was fitted to.
        predicted_gains: added effects that do not clearly lower the held-out error of simulation, but make the held-out experiments
            likelier one sample ahead.
        stopped: why the loop ended.
        seconds: duration [s].
        nearest: the effect of the last model that explains most, not all, of what the last diagnosis cannot name: a last resort,
            which serves held-out experiments better than a learned force; None elsewhere.
        learned: the learned force of the last model, the other last resort; None elsewhere.
        constancy: what differs between experiments, where the last model follows each by itself and not all together, or all
            but one together; None elsewhere.
        left_out: the experiment without which the last model was fitted, as one set of parameters follows all others and not it;
            None elsewhere. No error of `train` counts it.
        broken_off: whether the time that was given was over before all was asked.
        not_added: ids of what the last diagnosis names, and what was not fitted before the time was over.
        doubtful: ids of added effects that the last fit, by simulation, does not tell from nothing.
        hum: of the mains, which was subtracted first.
        by_predictions: the last model fitted by predictions one sample ahead, where nothing is missing and random forces lead its
            simulation astray: estimates to take in place of those of `final`; None elsewhere.
        unseen: names of parameters that show nowhere in what the first model simulates, and are held at its values.
    """

    fits: tuple[Fit, ...]
    diagnoses: tuple[Diagnosis, ...]
    diagnosed: tuple[int, ...]
    added: tuple[Candidate, ...]
    verdict: Verdict
    train: Comparison
    validation: Comparison
    held: tuple[str, ...]
    predicted: bool
    predicted_gains: tuple[PredictedGain, ...]
    stopped: str
    seconds: float
    learned: LearnedForce | None = None
    nearest: Candidate | None = None
    constancy: Equality | None = None
    left_out: str | None = None
    broken_off: bool = False
    not_added: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()
    hum: tuple[Hum, ...] = ()
    by_predictions: PredictorFit | None = None
    unseen: tuple[str, ...] = ()

    foreseen = renamed("foreseen", "predicted_gains")

    @property
    def base(self) -> Fit:
        """Return the fit without any effect added."""
        return self.fits[0]

    @property
    def final(self) -> Fit:
        """Return the last fit: with all effects added, or without the experiment that is left out."""
        return self.fits[-1]

    @property
    def ending(self) -> str:
        """Return what was held, or kept for its predictions, if anything, why the loop ended, and what was learned."""
        said = [str(one) for one in self.predicted_gains]
        if self.predicted:
            said.append(
                "All parameters of the last model are those with which the data are predicted best one sample ahead, as of "
                "est.prediction_error_nonlinear: with a fit by simulation the held-out experiments do not tell."
            )
        if self.held:
            counted = (
                " Standard deviations of the others count how well the diagnosis knew it." if self.final.held else ""
            )
            said.insert(
                0,
                f"Held at the estimate of the diagnosis, because a fit by simulation fails or serves held-out experiments worse: "
                f"{', '.join(self.held)}.{counted}",
            )
        if self.unseen:
            where = values_held(self.final.model, self.unseen, "its values")
            said.append(
                f"{', '.join(self.unseen)}: without effect on what the first model simulates, and held at {where}."
            )
        if self.left_out is not None:
            said.append(
                f"The last model is fitted without {self.left_out}, which no error of the fitted experiments counts."
            )
        if self.final.result in _UNFINISHED:
            said.append(f"The last model: {self.final.outcome}")
        elif not _shaken(self):
            said.extend(self.final.moved_constants)
        if self.diagnoses[-1].verdict == "adequate" and not _drifts(self) and (strays := _astray(self)):
            said.append(strays)
        told = [hum_subtracted(self.hum), *said, self.stopped, "" if self.learned is None else str(self.learned)]
        return " ".join(one for one in told if one)

    @property
    def settled(self) -> bool:
        """Return whether effects that were added, and nothing else, make the model follow all experiments to the noise."""
        others = (self.learned, self.nearest, self.left_out)
        if self.diagnoses[-1].broken_off:
            return False
        followed = [e.rms_over_noise for c in (self.train, self.validation) for e in c.models[-1].errors.values()]
        return self.mended == "adequate" and others == (None, None, None) and at_noise(max(followed))

    @property
    def names_nothing_sure(self) -> bool:
        """Return whether the last fit, far from the data, tells none of what was added from nothing, and is not adequate."""
        far = bool(self.added) and misfit(self.train.models[-1]) > FAR
        return far and self.mended != "adequate" and {c.id for c in self.added} <= set(self.doubtful)

    @property
    def mended(self) -> Verdict | None:
        """Return the verdict on the last model without a last resort, where effects were added and it was diagnosed again.

        None elsewhere.
        """
        after = sum(last is not None for last in (self.nearest, self.learned, self.left_out))
        with_all = len(self.fits) - 1 - after
        return self.diagnoses[-1].verdict if self.added and self.diagnosed[-1] >= with_all else None

    def fitted_before(self, diagnosis: int) -> int:
        """Return the place in `fits` of the model that a diagnosis, by its place, was made of."""
        return self.diagnosed[diagnosis]

    @property
    def headline(self) -> str:
        """Return what was found, in a few sentences: what differs, what was missing or still is, and what was learned."""
        if self.constancy is None:
            return _found(self)
        if self.left_out is None:
            return f"{self.constancy.differences} {_found(self)}"
        verdict = {
            "adequate": "predicted one sample ahead, which counts random forces, nothing is missing",
            "unknown": f"the model fails, and {self.diagnoses[-1].no_effect} explains that",
        }.get(
            self.diagnoses[-1].verdict,
            "the model fails, and what the diagnosis names does not serve held-out experiments",
        )
        return f"{self.constancy.differences} With {self.left_out} {verdict}."

    def overview(self) -> Overview:
        """Return the held-out errors of every model, and why the loop ended."""
        channels = dict.fromkeys(channel for model in self.validation.models for channel in model.errors)
        rows = [
            (model.label, *(f"{model.errors[c].rms_over_noise:.2f}" if c in model.errors else "" for c in channels))
            for model in self.validation.models
        ]
        header = ("model", *(f"{channel}, rms over noise" for channel in channels))
        return Overview(self.headline, header, rows, (self.ending,))

    def __str__(self) -> str:
        lines = []
        for diagnosis in self.diagnoses:
            lines.append(diagnosis.explanation)
        lines.append(self.ending)
        for title, comparison in (("train", self.train), ("validation", self.validation)):
            for model in comparison.models:
                errors = ", ".join(
                    f"{channel} {e.rms:.3g} ({e.rms_over_noise:.2f} times the noise)"
                    for channel, e in model.errors.items()
                )
                lines.append(f"{title:10s} {model.label:24s} {errors}")
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw the error before and after, as a matplotlib figure."""
        return draw(self)


def _shaken(found: Improvement) -> bool:
    """Return whether random forces lead the last simulation astray, so that no constant is judged by its estimates."""
    simulation = found.diagnoses[-1].simulation
    return simulation is not None and simulation.cause == "shaken"


def _drifts(found: Improvement) -> bool:
    """Return whether what differs between experiments is decided."""
    return found.constancy is not None and found.constancy.decisive


def _fails(found: Improvement) -> str:
    """Return the subject and verb of a sentence on a model that fails."""
    if _drifts(found):
        return "One set of parameters for all fails"
    return f"The model {_failure(found, fails='fails')}" if not found.added else "The model fails"


def _found(found: Improvement) -> str:
    """Return what the first model lacked, what the last one lacks, what was learned."""
    if found.nearest is not None:
        explained = 100 * found.nearest.error_reduction
        return (
            f"{_named(found)} The nearest, {found.nearest.id}, explains {explained:.0f} % of what is left: it is likely, and "
            f"not certain. It changes the held-out error {_change(found)}."
        )
    if found.learned is None:
        return _named(found)
    return (
        f"{_named(found)} A learned force on the {found.learned.port} against {found.learned.variable}, which is no physical "
        f"effect, changes the held-out error {_change(found)}."
    )


def _astray(found: Improvement) -> str:
    """Return what random forces do to the last simulation, in words."""
    return astray(found.train.models[-1], found.validation.models[-1])


def _failure(found: Improvement, *, fails: str = "still fails") -> str:
    """Return what the diagnosed model leaves, in words."""
    place = found.diagnosed[-1]
    return failure(found.train.models[place], found.validation.models[place], fails=fails)


def _but(found: Improvement) -> str:
    """Return what an adequate model's simulation leaves of held-out experiments, where that is no noise; else nothing."""
    trained, tested = found.train.models[-1].errors, found.validation.models[-1].errors
    worst = max((e.rms_over_noise for e in tested.values()), default=0.0)
    beyond = not at_noise(worst) and all(at_noise(trained[c].rms_over_noise) for c in tested if c in trained)
    if not _astray(found) and not beyond:
        return ""
    worst = max(e.rms_over_noise for e in tested.values()) if _astray(found) else worst
    missed = max(100 - e.fit_percent for e in tested.values() if e.rms_over_noise == worst)
    much = f", {missed:.0f} % of their motion" if _MUCH <= missed < float("inf") else ""
    return f"; of the held-out experiments its simulation leaves {rounded(worst)} times the noise{much}"


def _lost(found: Improvement) -> bool:
    """Return whether the last simulation misses most of a channel's held-out motion, which is far from the noise.

    Where it follows what was fitted down to the noise no random forces excuse it, and a quarter is as much.
    """
    trained, tested, policy = (
        found.train.models[-1].errors,
        found.validation.models[-1].errors,
        found.diagnoses[-1].policy,
    )
    at_the_noise = all(at_noise(e.rms_over_noise) for e in trained.values())
    most = 100 * (1 - (policy.unfollowed if at_the_noise else policy.static))
    return any(e.fit_percent < most and e.rms_over_noise > FAR for e in tested.values())


def _holds_there_only(found: Improvement) -> bool:
    """Return whether the last simulation is far from a held-out channel, and as much farther than from what was fitted."""
    trained, tested = found.train.models[-1].errors, found.validation.models[-1].errors
    far = {c: e.rms_over_noise for c, e in tested.items() if e.rms_over_noise > FAR and c in trained}
    return any(ratio > FAR * max(trained[c].rms_over_noise, 1.0) for c, ratio in far.items())


def _adequate(found: Improvement) -> str:
    """Return the verb of a sentence on a model that nothing rejects."""
    return "does not follow what was held out" if _lost(found) else "is adequate"


def _for_fitted_only(found: Improvement) -> str:
    """Return that an adequate model is so for what was fitted only; nothing where it is not, or does not follow the rest at all."""
    return ", for what was fitted only" if _holds_there_only(found) and not _lost(found) else ""


def _change(found: Improvement) -> str:
    """Return what the last resort does to the held-out error over the noise, by channel."""
    models = found.validation.models[: None if found.left_out is None else -1]
    before, after = (model.errors for model in models[-2:])
    falls = [f"of {c} from {e.rms_over_noise:.3g} to {after[c].rms_over_noise:.3g}" for c, e in before.items()]
    return f"{' and '.join(falls)} times the noise"


def _named(found: Improvement) -> str:
    """Return what the first model lacked, and what is said of the last."""
    whole = "it" if found.nearest is None else "all of it"
    if not found.added:
        last = found.diagnoses[-1]
        if last.silent:
            return f"{last.silent}."
        if line := last.line_alone:
            return (
                f"The model follows the recording to {last.simulated:.2f} times the noise, and only a line speaks against it, "
                f"which {last.no_effect} explains: {line}."
            )
        if last.drift and found.nearest is None:
            return (
                f"The model fails as where a parameter drifts: {last.drift}. {last.no_effect.capitalize()} explains it."
            )
        if found.not_added:
            return f"The model fails. {named_too_late(found.not_added)}."
        if last.rounding and found.nearest is None and found.learned is None:
            return (
                f"The model follows the recording to {last.simulated:.2f} times the noise, and what speaks against it may be "
                f"how coarsely it was recorded: {last.rounding}."
            )
        return {
            "adequate": f"The model {_adequate(found)}: nothing is missing {last.floor}{_for_fitted_only(found)}{_in_time(found)}"
            f"{_but(found)}.",
            "unknown": f"{_fails(found)}, and {found.diagnoses[-1].no_effect} explains {whole}.",
        }.get(
            found.diagnoses[-1].verdict,
            "One set of parameters for all fails, and what the diagnosis names explains less."
            if _drifts(found)
            else "The model fails, and what the diagnosis names does not serve held-out experiments.",
        )
    if found.names_nothing_sure:
        return unsure(found.doubtful, _fails(found), misfit(found.train.models[-1]))
    sure = [candidate.id for candidate in found.added if not candidate.confusable_with]
    laws = {e.id for e in found.final.model.effects if isinstance(e, FormulaForce)}
    told = [f"{i} (a law read off the data)" if i in laws else i for i in sure]
    start = f"{', '.join(told)} {'was' if len(sure) == 1 else 'were'} missing" if sure else ""
    groups = {tuple(sorted({c.id, *c.confusable_with} - set(sure))): c.id for c in found.added if c.confusable_with}
    for several, first in groups.items():
        group = ", ".join([first, *(name for name in several if name != first)])
        start = f"{start}, and one of a group ({group})" if start else f"One of a group was missing ({group})"
    if groups:
        start += ", and the data cannot tell which"
    drift = "" if found.nearest is not None else found.diagnoses[-1].drift
    line = found.diagnoses[-1].line_alone
    end = {
        "adequate": f"the mended model {_adequate(found)}"
        f"{' one sample ahead' if _astray(found) and not _lost(found) else ''}{_for_fitted_only(found)}{_but(found)}"
        f"{_in_time(found)}",
        "unknown": f"the mended model fails as where a parameter drifts: {drift}"
        if drift
        else f"only a line speaks against the mended model: {line}"
        if line
        else f"the mended model {_failure(found)}, and {found.diagnoses[-1].no_effect} explains {whole}",
        None: "the mended model was not diagnosed again",
    }.get(found.mended, "what a diagnosis of the mended model names does not serve held-out experiments")
    if found.not_added:
        end = f"the mended model still fails, and {named_too_late(found.not_added)}"
    # What else was broken off, as the colour of the noise, is no effect.
    unfitted = {name for d in found.diagnoses if d.effects for name in d.broken_off if " " not in name}
    asked = sorted(unfitted - set(sure) - set(groups.values()))
    rivals = f" Not fitted before the time was over, so that none is ruled out: {', '.join(asked)}." if asked else ""
    after = sum(last is not None for last in (found.nearest, found.learned, found.left_out))
    places = 0, len(found.fits) - 1 - after
    first, last = (found.validation.models[place] for place in places)
    trained = found.train.models[places[0]], found.train.models[places[1]]
    counted = 0 if found.predicted_gains else len(found.added)
    little = of_little_service(first, last, counted, found.diagnoses[0].policy, trained)
    constants = stands_for([i for c in found.added for i in (c.id, *c.confusable_with)], found.base.model)
    return f"{start}; {end}.{rivals}{little}{not_told_from_nothing(found.doubtful)}{constants}"


def _in_time(found: Improvement) -> str:
    """Return the words of an answer that was cut short."""
    return ", as far as was asked before the time was over" if found.diagnoses[-1].broken_off else ""
