"""The loop: compare, diagnose, add the effect, fit again, until nothing rejects or the held-out error stops falling."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from estimators.core.deadline import PROLONGED, Deadline
from estimators.core.fit import Fit
from estimators.core.threads import one_blas_thread
from estimators.diagnosis.caveats import doubtful
from estimators.diagnosis.diagnose import compile_diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.diagnosis.improvement_loop import OUT_OF_TIME, Loop
from estimators.diagnosis.loop_end import end_of
from estimators.diagnosis.loop_on_part import loop_from_part
from estimators.diagnosis.loop_run import run
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.part_of_samples import part_of
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.removed_error import Verdict
from estimators.output_error.fit_what_shows import fit_what_shows
from estimators.validation.simulation_error import Comparison, compare
from rtac_jax import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording


@checked_arguments
@one_blas_thread()
def improve(
    model: RTAC,
    recording: Recording,
    *,
    validation: Sequence[str] | None = None,
    candidates: Sequence[type[Effect]] | None = None,
    most: int = 4,
    thorough: bool = True,
    learned_force: bool = True,
    policy: DiagnosisPolicy = STANDARD,
    within: float | None = None,
    progress: bool = True,
) -> Improvement:
    """Fit, diagnose, add what is missing, fit again, and validate on experiments that no fit has seen.

    An effect is kept if the error of the held-out experiments falls clearly in the channels together: by a twentieth, or,
    near the noise, at all. Where it does not, or where the effect cannot be fitted by simulation, as on a rig that random
    forces shake, the effect is held at the estimate of the diagnosis, which predicts one sample at a time, and asked again;
    then the whole model is fitted by such predictions (`prediction_error_nonlinear`), with the effect and without. Where
    none of the three tells, the one is kept that predicts the held-out experiments best one sample at a time, if better than
    any model without the effect: where random forces shake the rig, or the arm tumbles, no simulation can follow it, however
    right the model is. Last, an error that falls a little is enough, if predictions do not speak against it. The held-out
    experiments choose the models by that, so their last error is a little too good.

    Hum of the mains is subtracted first (`Recording.without_hum`).

    Args:
        model: the base model.
        recording: with enough moving experiments to hold some out.
        validation: names of the experiments to hold out; by default every fourth of each kind, or the last quarter of the
            only one (`Recording.divided`).
        candidates: classes of effects to try; by default the whole catalogue.
        most: effects to add at most.
        thorough: where a verdict would be unknown, look again at what raised no alarm; that may take minutes.
        learned_force: where the last verdict is unknown, and an effect explains most of what is missing, add it and go on: two may
            hide each other. Where that does not end at an adequate model, add as a last resort that effect or a learned force
            (`LearnedForce`): what serves held-out experiments better, if their error clearly falls, and more than by leaving out an
            experiment that differs. The verdict stays.
        policy: the thresholds of every diagnosis; see `DiagnosisPolicy`.
        within: seconds after which an answer is wanted. After three quarters of them nothing more is diagnosed, and `stopped` says
            so; the rest is for adding what was named, or a last resort. The fit of the base model counts, and is not broken off. By
            default the loop goes on to its end. What the same seconds suffice for differs from machine to machine.
        progress: show bars.

    Raises:
        ValueError: there is nothing to hold out, or nothing moves.
        NotIdentifiableError, DivergedError: as `output_error`, for the base model.
    """
    began, deadline = time.perf_counter(), Deadline.of_searching(within)
    hum, recording = recording.hum(), recording.without_hum()
    recording = recording.divided() if validation is None else recording
    train, held_out = recording.split(validation)
    with ThreadPoolExecutor(1) as other:
        other.submit(compile_diagnosis, model, train, candidates)

        def loop_of(fitted: Recording, base: Fit) -> Loop:
            tested = compare(base, held_out, labels=["base"], hold_diverging=True).models[0]
            return Loop(
                fitted, held_out, candidates, most, thorough, policy, progress,
                [((), Added(base, tested, "simulated"))], deadline=deadline, laws=learned_force, part=part_of(fitted),
            )  # fmt: skip

        loop = loop_from_part(model, train, loop_of, policy, progress=progress)
        if loop is None:
            base, unseen = fit_what_shows(model, train, progress=progress)
            loop = loop_of(train, base)
            loop.unseen = unseen
    run(loop)
    with deadline.prolonged(PROLONGED).kept():
        ended = end_of(loop, last_resort=learned_force)
    loop, learned, nearest = ended.loop, ended.learned, ended.nearest
    if ended.out_of_time and not loop.out_of_time:
        loop.stopped = f"{loop.stopped} {OUT_OF_TIME.removeprefix('Stopped: ').capitalize()}"
    steps, diagnoses, added = loop.steps, loop.diagnoses, loop.added
    fits = [step.fit for _, step in steps]
    tested = [step.tested for _, step in steps]
    labels = [model.label for model in tested]
    said = diagnoses[-1].verdict
    colour = diagnoses[-1].colour_told
    verdict: Verdict = "unknown" if said in ("missing", "ambiguous") else said
    if loop.not_added:
        verdict = said
    if added:
        verdict = "ambiguous" if any(c.confusable_with for c in added) else "missing"
    return Improvement(
        fits=tuple(fits),
        diagnoses=tuple(diagnoses),
        diagnosed=tuple(loop.diagnosed),
        added=tuple(added),
        verdict=verdict,
        train=compare(fits, loop.followed, labels=labels, hold_diverging=True).with_noise(colour),
        validation=Comparison(tuple(tested)).with_noise(colour),
        held=loop.held,
        predicted=steps[-1][1].way == "predicted",
        predicted_gains=tuple(step.predicted_gain for _, step in steps if step.predicted_gain is not None),
        stopped=loop.stopped,
        seconds=time.perf_counter() - began,
        learned=learned,
        nearest=nearest,
        constancy=ended.differs,
        left_out=loop.left_out,
        hum=hum,
        broken_off=loop.out_of_time or ended.out_of_time or any(d.broken_off for d in diagnoses),
        not_added=loop.not_added,
        by_predictions=ended.by_predictions,
        unseen=loop.unseen,
        doubtful=doubtful(loop.last.fit, loop.followed, added) if loop.last.way == "simulated" else (),
    )
