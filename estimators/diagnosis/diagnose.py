"""Diagnosis of the missing effect: candidates ranked on a predictor's innovations, refitted, judged, and added."""

import dataclasses
import time
import warnings
from collections.abc import Sequence

import numpy as np

from estimators.core.compilation import make_room
from estimators.core.data import Data, fitted_part, moving, pieces
from estimators.core.deadline import Deadline
from estimators.core.fit import Fit
from estimators.core.progress import Progress
from estimators.core.sensor_noise import rounded
from estimators.core.threads import one_blas_thread
from estimators.diagnosis.base_predictor import compile_base, compile_for, fit_base, trusting, with_predictive_steps
from estimators.diagnosis.candidate_results import candidates_of, nearest_simulated, not_testable
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.explanation import (
    OF_A_DRIFT,
    OF_A_LIKELY_DRIFT,
    OF_A_LINE,
    OF_PART_IN_TIME,
    OF_ROUNDING,
    SHAKEN,
    not_named,
    of_part,
    out_of_time,
    shaken,
    strayed,
    surer,
    unconfirmed,
    without_alarm,
    words,
)
from estimators.diagnosis.gross_effects import is_gross, offering_gross
from estimators.diagnosis.innovation_tests import (
    latent_of,
    lines_of,
    pieces_of_tests,
    places_of,
    run_tests,
)
from estimators.diagnosis.live_laboratory import LiveLaboratory
from estimators.diagnosis.noise_colour import assumed_noise, recoloured
from estimators.diagnosis.part_of_samples import Looked, enough_of, part_of, suffices
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.setting import Setting, effect_of, setting_of
from estimators.diagnosis.simulation_remarks import found_by_simulation, of_nearest, untried, without_the_physics
from estimators.diagnosis.testability import stood_for
from estimators.diagnosis.verdict import Judgement, decide, is_of_the_current, judge
from estimators.diagnosis.workers import Workers
from estimators.diagnosis.wrong_constant import doubt
from estimators.inference.shaken_simulation import unfollowed
from estimators.inference.simulation_residual import random_forces_are_large
from estimators.misspecification.adequacy import alarming
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.effects import Effect
from rtac_jax.measurement import OUTPUTS, Experiment, Recording

_SLIGHT = (
    " Its simulation is left at {:.2f} times the noise, though: what is missing shows in predictions one sample ahead, and next to"
    " nothing of it in a simulation."
)


@checked_arguments
@one_blas_thread()
def diagnose(
    fit: Fit,
    recording: Recording,
    *,
    candidates: Sequence[type[Effect]] | None = None,
    thorough: bool = True,
    policy: DiagnosisPolicy = STANDARD,
    within: float | None = None,
    progress: bool = True,
    laws_first: bool = False,
) -> Diagnosis:
    """Say which effects the model of a fit leaves out, or that none is, or that the data cannot say.

    Args:
        fit: of the base model to this recording.
        recording: that the model was fitted to; experiments that the fit did not use are left out.
        candidates: classes of effects to try; by default the whole catalogue, and that a constant is wrong which the model takes
            as exact beside others. Those of the model are passed over.
        thorough: where the verdict would be unknown, look again at what raised no alarm; that may take minutes.
        policy: the thresholds; see `DiagnosisPolicy`.
        within: seconds after which an answer is wanted. After three quarters of them no further effect is fitted, and the verdict
            is of what was until then, and says so; the rest is for holding what is named against a simulation. By default
            the diagnosis goes on to its end. What the same seconds suffice for differs from machine to machine.
        progress: show how far it is, as `core.progress.Progress` does.
        laws_first: do not look again at what raised no alarm where a force of one variable explains nearly all that is missing, and
            no effect does: a law may be read off it (`curves[0].formulas()`), as `improve` does. `awaits_law` tells.

    Raises:
        ValueError: nothing that was fitted is in the recording, no candidate is left, or one is declared so that it cannot be
            looked for.
        RuntimeError: JAX was not configured for double precision.

    Source: the steps of Kristensen, Madsen and Jorgensen (2004) for the predictor; score tests as in Basseville and
    Nikiforov, Detection of Abrupt Changes (1993), section 7.
    """
    require_configured()
    make_room()
    began, deadline = time.perf_counter(), Deadline.of_searching(within)
    recording = fitted_part(recording, fit.experiments)
    classes = offered(fit.model, candidates)
    if not classes:
        raise ValueError(
            "no candidate is left: the model has every effect that was offered, or lacks what they stand beside."
        )
    # Whatever deadline whoever asks keeps: refits alone are broken off.
    with Deadline().kept(), Progress("diagnose", show=progress) as shown:
        part = enough_of(fit, recording, policy)
        cut = part is not recording
        gross = cut and unfollowed(fit, Data.of(pieces(moving(recording))), policy.simulation) > policy.unfollowed

        def looked(at: Recording) -> Looked:
            return _diagnosed(
                fit, at, candidates, classes, policy, shown, deadline,
                part=at is not recording, thorough=thorough, laws_first=laws_first,
            )  # fmt: skip

        first = looked(part)
        told = first.told
        if cut:
            looked_at = sum(e.samples for e in moving(part))
            times = sum(e.samples for e in moving(recording)) / looked_at
            if suffices(first, fit, recording, times=times, gross=gross):
                told = dataclasses.replace(
                    told, explanation=told.explanation + of_part(looked_at, gross=gross, named=bool(told.additions))
                )
            elif deadline.over:
                told = dataclasses.replace(told, explanation=told.explanation + OF_PART_IN_TIME.format(looked_at))
            else:
                del first  # what it computed takes as much memory again
                told = looked(recording).told
    return dataclasses.replace(told, seconds=time.perf_counter() - began)


def _diagnosed(
    fit: Fit,
    recording: Recording,
    candidates: Sequence[type[Effect]] | None,
    classes: Sequence[type[Effect]],
    policy: DiagnosisPolicy,
    shown: Progress,
    deadline: Deadline,
    *,
    part: bool,
    thorough: bool,
    laws_first: bool,
) -> Looked:
    """Diagnose a fit by the recording that it was fitted to, or by a part of it."""
    setting = setting_of(fit, recording, classes, shown, policy, part=part)
    # Where some are in the model already, as in the loop, its other tests are still worth asking.
    if not setting.absent and not any(c.id in fit.model for c in candidates or ()):
        raise ValueError(
            f"no candidate is left: nothing in the recording could show {', '.join(c.id for c in classes)}."
        )
    with warnings.catch_warnings():  # what threads do to the filters at the same time ends here
        laboratory = _begun(setting, fit, Workers(), deadline, whole=candidates is None)
        decide(laboratory, policy, thorough=thorough, laws_first=laws_first)
        evidence = laboratory.evidence(thorough=thorough, laws_first=laws_first)
    shown.at("diagnose: verdict")
    unshown = [c for c in classes if c.id not in setting.absent and not stood_for(c, setting.experiments)]
    found = judge(evidence, policy)
    told = _told(laboratory, evidence, found, unshown, fit)
    facts = evidence.facts
    unexplained = told.simulation is not None and told.simulation.cause == "unexplained"
    unasked = told.verdict == "adequate" and not facts.noise_known
    if (unexplained or unasked) and max(told.random_force, told.random_torque) < SHAKEN:  # or else they are the reason
        said = strayed(fit.residual_std, fit.noise, recording, unfollowed=facts.unfollowed, poor=policy.simulation.poor)
        told = dataclasses.replace(told, explanation=told.explanation + said)
    return Looked(told, laboratory, found)


def _begun(setting: Setting, fit: Fit, workers: Workers, deadline: Deadline, *, whole: bool) -> LiveLaboratory:
    """Return a laboratory with the base model fitted and tested, while another thread compiles what comes next.

    Args:
        setting: the data and the candidates.
        fit: that is diagnosed.
        workers: compute side by side.
        deadline: after which no refit goes on.
        whole: whether the candidates are all that are known.
    """
    setting.progress.at("diagnose: predictor of the base model")
    first = setting
    with workers.compiling(pieces_of_tests(first), before=lambda: compile_base(first)) as ahead:
        setting = with_predictive_steps(setting)
        setting, base = recoloured(setting, fit_base(setting))
        setting, base = trusting(setting, base)
        if whole and is_gross(setting, fit, base):
            setting = offering_gross(setting)
        setting.progress.at("diagnose: candidates")
        return LiveLaboratory(setting, fit, base, run_tests(setting, base, ahead), workers, deadline)


def _told(
    laboratory: LiveLaboratory,
    evidence: Evidence,
    found: Judgement,
    unshown: Sequence[type[Effect]],
    fit: Fit,
) -> Diagnosis:
    """Return the verdict and its reasons, also of candidates that nothing in the recording could show."""
    setting, base = laboratory.models.computed(found.selection.base)
    coloured = assumed_noise(setting, base, fit.noise)
    beside = {c: ratio / max(coloured.get(c, 0.0) / fit.noise[c], 1.0) for c, ratio in fit.residual_over_noise.items()}
    tested = laboratory.models.tested(found.selection.base)
    stood = found.simulation is None or not found.simulation.vetoes
    silent = laboratory.facts.silent or laboratory.facts.stuck
    latent = latent_of(setting, base) if found.verdict == "unknown" and stood and not silent else ()
    candidates = candidates_of(laboratory, found)
    candidates += [not_testable(c, float(np.log(setting.samples))) for c in unshown]
    groups = [(step.id, *step.rivals) for step in found.steps]
    by_id = {c.id: c for c in candidates}
    _, final = laboratory.models.computed(found.final)
    told = Diagnosis(
        verdict=found.verdict,
        effects=tuple(
            dataclasses.replace(by_id[i], confusable_with=tuple(other for other in group if other != i))
            for group in groups
            for i in group
        ),
        additions=tuple(effect_of(setting, step.id, final) for step in found.steps),
        candidates=tuple(candidates),
        tests=found.selection.tests,
        left=found.left,
        removed=found.removed,
        curves=tested.curves,
        latent=latent,
        places=places_of(setting, base),
        lines=lines_of(setting, base),
        random_force=base.predictor.random_force,
        random_torque=base.predictor.random_torque,
        explanation="",
        seconds=0.0,
        simulation=found.simulation,
        policy=setting.policy,
        evidence=evidence,
        consequence=found.consequence,
        detectable=tuple(by_id[step.id] for step in found.detectable),
        simulated=max(beside.values(), default=0.0),
        coloured=coloured,
        by_simulation=bool(found.steps and found.selection.simulated),
        rounded=rounded(setting.experiments, laboratory.facts.noise),
        values={name: float(value) for name, value in final.values.items()},
        broken_off=laboratory.broken_off,
        awaits_law=found.selection.static,
        nearest_simulated=nearest_simulated(laboratory, found, by_id),
    )
    return dataclasses.replace(told, explanation=_explanation(told, found, setting, thorough=evidence.thorough))


def _extents(experiments: Sequence[Experiment]) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest value of each output in experiments, SI units."""
    found: dict[str, tuple[float, float]] = {}
    for experiment in experiments:
        for channel, signal in experiment.outputs.items():
            low, high = found.get(channel, (np.inf, -np.inf))
            found[channel] = min(low, float(np.nanmin(signal.values))), max(high, float(np.nanmax(signal.values)))
    return found


def _explanation(told: Diagnosis, found: Judgement, setting: Setting, *, thorough: bool) -> str:
    """Return the verdict in plain words, with what it rests on and what would make it surer."""
    steps, further = found.steps, found.further
    if told.silent:
        return f"Unknown: {told.silent[0].lower()}{told.silent[1:]}. {told.silent_mend}"
    text = words(
        told.verdict, told.effects, told.candidates, steps, told.tests, told.left, told.removed, told.curves, told.latent,
        told.places, told.lines, told.simulation, told.policy, told.consequence, found.detectable,
        told.floor, told.misfit, told.no_effect,
    )  # fmt: skip
    if told.simulation is not None and further and not steps:
        text += without_the_physics(further, told.simulation)
    text += of_nearest(told.nearest_simulated)
    if told.by_simulation and told.evidence is not None:
        known = told.evidence.simulations
        text += found_by_simulation(known[found.selection.base.number], known[found.final.number], told.coloured)
        fitted = {effect for (_, effect), errors in told.evidence.simulated.items() if errors}
        text += untried(told.candidates, fitted, told.left, told.policy)
    if steps and further:
        text += not_named(further, told.left, setting.samples)
    alarms = alarming(found.selection.findings.scores, told.policy.critical)
    if steps and not found.selection.simulated and steps[0].id not in {s.id for s in alarms}:
        text += without_alarm(steps[0].id, found.selection.confirmed, hid=found.selection.hid)
    if told.verdict == "adequate":
        asked = thorough and not told.broken_off
        text += unconfirmed(told.candidates, told.detectable, told.policy, thorough=asked)
    if told.line_alone:
        text += OF_A_LINE.format(told.simulated)
    elif told.rounding:
        text += OF_ROUNDING.format(told.simulated, " and ".join(told.rounded))
    elif told.slight:
        text += _SLIGHT.format(told.simulated)
    if told.drift:
        text += OF_A_DRIFT
    elif told.likely_drift:
        text += OF_A_LIKELY_DRIFT
    # What a remark computes of other parameters is to be of where they ended, and not of the model that fails.
    ended = setting.model.with_values({n: v for n, v in told.values.items() if n in setting.model.parameters})
    text += "".join(f" {remark}" for effect in told.additions if (remark := effect.remark(ended.body)))
    extents = _extents(setting.experiments)
    text += "".join(f" {sentence}" for effect in told.additions if (sentence := effect.unseen(extents)))
    if struck := [effect.id for effect in told.additions if effect.acts_by_contact]:
        text += (
            f" The intervals of {', '.join(struck)} may be far too narrow: they leave out when parts hit each other."
        )
    if told.awaits_law:
        text += " As that explains nearly all, what raised no alarm was not tried: a law may be read off it."
    elif told.verdict == "unknown" and told.simulation is None and not thorough:
        text += " This was a quick diagnosis: a thorough one also tries what raised no alarm."
    vetoed = told.simulation is not None and told.simulation.vetoes
    if not vetoed and not any(
        test.rejects for test in told.left
    ):  # or else random forces may stand for what is still missing
        random = found.final.random
        large = random_forces_are_large(random, float(setting.samples_per_radian), told.policy.simulation)
        known = told.evidence is not None and is_of_the_current(told.evidence.facts, random, told.policy)
        text += shaken(*random, setting.left_out, large=large, of_the_current=known)
    if told.broken_off:
        text += out_of_time(told.broken_off, {c.id for c in told.candidates if c.refitted})
    if setting.assumed:
        sizes = told.coloured
        shown = [f"{c} ({sizes[c]:.2g} {OUTPUTS[c]} rms)" if c in sizes else c for c in setting.assumed]
        text += f" Coloured noise of {', '.join(shown)} was assumed: the data are far more likely with it."
    text += doubt([c.id for c in told.effects], setting.model)
    return text + surer(told.verdict, setting.recording)


def compile_diagnosis(model: RTAC, recording: Recording, candidates: Sequence[type[Effect]] | None) -> None:
    """Compile what `diagnose` will run first; for a thread beside the one that fits the model.

    Of a long recording that is a part, unless the fit ends at the noise.
    """
    part = recording if model.per_experiment else part_of(recording)
    compile_for(model, part, offered(model, candidates), part=part is not recording)
