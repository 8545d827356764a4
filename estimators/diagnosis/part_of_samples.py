"""A part of the samples of a long recording, which shows what a fit misses by more than the noise as well as all of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from estimators.core.data import Data, motion_of, moving, origins, pieces
from estimators.core.fit import Fit
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.evidence import Evidence, FittedModel
from estimators.diagnosis.live_laboratory import LiveLaboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.removed_error import removed_beside
from estimators.diagnosis.setting import Setting, begun, set_up, space_for
from estimators.diagnosis.step import Step
from estimators.diagnosis.verdict import Judgement
from estimators.inference.shaken_simulation import unfollowed
from estimators.misspecification.adequacy import excess_of
from estimators.prediction_error.filter_pass import run_filter
from rtac_jax.measurement import Experiment, Recording

# Samples of all experiments together. What takes a hundredth off the rms error (`DiagnosisPolicy.consequence`) scores 320 in them,
# sixteen times what an alarm asks for; seeded studies of the diagnosis have 15,000.
_ENOUGH = 16_000
_LEAST = 1_000  # of each of many experiments
_LIVELY = 0.5  # rms of a beginning over that of the whole, from which on it shows as much


def part_of(recording: Recording) -> Recording:
    """Return the beginning of every experiment of a long recording, if they show as much motion, or else the recording.

    What dominates an error shows in a part of many samples as well, and every refit takes as long as there are samples.
    """
    whole = moving(recording)
    several = pieces(whole)
    if sum(e.samples for e in several) < 2 * _ENOUGH:
        return recording
    samples = max(_ENOUGH // len(whole), _LEAST)
    origin = origins(whole)
    found = [_beginning([e for e in several if origin[e.name] == one.name], samples) for one in whole]
    part = [e for beginnings in found for e in beginnings]
    if sum(e.samples for e in part) == sum(e.samples for e in several):
        return recording
    if np.any(motion_of(Data.of(part)) < _LIVELY * motion_of(Data.of(several))):
        return recording
    rest = [e for e in recording.experiments if e.kind == "rest"]
    return dataclasses.replace(recording, experiments=(*part, *rest))


def enough_of(fit: Fit, recording: Recording, policy: DiagnosisPolicy) -> Recording:
    """Return the part of a recording that a diagnosis looks at first: all of it where the fit is at the noise.

    What is small beside what is found in a part is for the diagnosis of the model with it, which sees all.

    Args:
        fit: that is diagnosed.
        recording: that it was fitted to.
        policy: the thresholds.
    """
    if fit.model.per_experiment:  # values that belong to the experiments of the fit, as they were cut there
        return recording
    part = part_of(recording)
    if part is recording or unfollowed(fit, Data.of(pieces(moving(recording))), policy.simulation) == 0.0:
        return recording
    return part


class Looked(NamedTuple):
    """A diagnosis, and what it was made of."""

    told: Diagnosis
    laboratory: LiveLaboratory
    found: Judgement

    def told_by_more(self, times: float) -> bool:
        """Return whether so many times the samples would tell effects apart that are named together."""
        evidence = self.laboratory.evidence(thorough=False, laws_first=False)
        return told_by_more(evidence, self.found, self.laboratory.policy, times)

    def left_of_all(self, fit: Fit, recording: Recording) -> float:
        """Return the mean square that the last model of a part leaves of all samples; infinite where simulations told it."""
        if self.found.selection.simulated:
            return float("inf")
        setting, final = self.laboratory.models.computed(self.found.final)
        return left_of_all(setting, final, fit, recording)


def told_by_more(evidence: Evidence, found: Judgement, policy: DiagnosisPolicy, times: float) -> bool:
    """Return whether so many times the samples would tell effects apart that are named together.

    Args:
        evidence: of the diagnosis of a part.
        found: its judgement.
        policy: the thresholds.
        times: as many samples there are.
    """
    if found.selection.simulated:
        return any(step.rivals for step in found.steps)
    models = {model.number: model for model in evidence.models}
    refits = {(r.before, r.effect): models[r.after] for r in evidence.refits if r.after is not None}
    return is_told_by_more(
        found.selection.base, found.steps, refits, policy, samples=evidence.facts.samples, times=times
    )


def suffices(looked: Looked, fit: Fit, recording: Recording, *, times: float, gross: bool) -> bool:
    """Return whether a diagnosis of a part need not be asked of all samples.

    What it names has to explain everything by effects that explain all samples, too, and that it tells from all others as well as
    all samples would. Where it names nothing, as no effect explains enough, that is the answer where the misfit is no small one,
    and so large beside what only the rest shows that nothing that explains the rest alone would be named.

    Args:
        looked: the diagnosis of the part.
        fit: that is diagnosed.
        recording: that it was fitted to.
        times: as many samples there are.
        gross: whether the fit follows nothing. Then any effect that is added brings it nearer.
    """
    told, found, policy = looked.told, looked.found, looked.laboratory.policy
    if told.additions:
        if gross:
            return True
        if looked.told_by_more(times):
            return False
        left = looked.left_of_all(fit, recording)
        return (
            bool(np.isfinite(left))
            and removed_beside(found.steps, looked.laboratory.facts.samples, left) >= policy.removed
        )
    unexplained = excess_of(found.left) / looked.laboratory.facts.samples
    if told.broken_off or told.verdict != "unknown" or unexplained < 2 * policy.consequence:  # of squares
        return False
    # To be named, what only the rest shows has to be nearly all that all samples leave.
    return policy.left * (looked.left_of_all(fit, recording) - 1) <= policy.removed * unexplained


def is_told_by_more(
    base: FittedModel,
    steps: Sequence[Step],
    refits: Mapping[tuple[int, str], FittedModel],
    policy: DiagnosisPolicy,
    *,
    samples: int,
    times: float,
) -> bool:
    """Return whether so many times the samples would tell a step from one of its rivals: likelihoods differ in proportion to them.

    Where a rival's refit beside a step is not known, all samples have to tell.

    Args:
        base: the model before the first step.
        steps: that a part names.
        refits: models with one effect more, by number of the model before and id of the effect.
        policy: the thresholds.
        samples: of the part.
        times: as many samples there are.
    """
    before = base
    for step in steps:
        for rival in step.rivals:
            known = refits.get((before.number, rival))
            if known is None:
                return True
            more = step.model.parameters - known.parameters
            apart = 2 * (step.model.log_likelihood - known.log_likelihood)
            if abs(times * apart - more * np.log(times * samples)) > policy.bic_gain:
                return True
        before = step.model
    return False


def left_of_all(setting: Setting, final: Refit, fit: Fit, recording: Recording) -> float:
    """Return the mean square of the innovations of all samples in their own standard deviation, as far as a part tells.

    The predictor of the part, with all its estimates and noise, is run along the whole recording. What chance makes of them is not
    counted.

    Args:
        setting: of the diagnosis of the part.
        final: the predictor of the last model.
        fit: that is diagnosed.
        recording: that it was fitted to.
    """
    model = final.model.with_values(final.values)
    whole = set_up(model, recording, [], fit.start, int(setting.substeps), setting.progress, setting.policy)
    space = begun(space_for(whole, model, final.free), model, {})
    physical, prior = (space.values, space.each_values, space.start), setting.prior.starting(space)
    passed = run_filter(model, whole.data, space, physical, prior, final.predictor.noise, setting.substeps)
    given = (passed.innovations, whole.data.counted, passed.shaken)
    return left_beyond_chance(*map(np.asarray, given), samples=setting.samples)


def left_beyond_chance(
    innovations: Float[np.ndarray, "sample output experiment"],
    counted: Float[np.ndarray, "sample output experiment"],
    shaken: Float[np.ndarray, "sample experiment"],
    *,
    samples: int,
) -> float:
    """Return the mean square of innovations in their own standard deviation, less what chance makes of it.

    The noise is known from a part only: a standard deviation of what the scatter of both variances makes is no misfit.

    Args:
        innovations: of all samples.
        counted: 1 where they count.
        shaken: 1 where neither rest nor motion of the model is to be believed, and they do not.
        samples: number of those that the noise was estimated from.
    """
    there = counted * (1.0 - shaken)[:, None]
    mean = float(np.sum(innovations**2 * there) / np.sum(there))
    return mean - float(np.sqrt(2.0 / samples + 2.0 / np.sum(there)))


def _beginning(several: Sequence[Experiment], samples: int) -> list[Experiment]:
    """Return the beginning of an experiment, or those of its pieces, from first to last, that have about as many samples."""
    if len(several) > 1:
        count = min(max(samples // several[0].samples, 1), len(several))
        return [several[place] for place in np.linspace(0, len(several) - 1, count).astype(int)]
    return [several[0].cut(0, min(samples, several[0].samples), several[0].name)]
