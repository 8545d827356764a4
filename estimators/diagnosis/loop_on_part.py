"""The beginning of the loop on a part of a long recording, which shows what dominates before all samples are fitted."""

import dataclasses
from collections.abc import Callable

from estimators.core.data import Data, moving, pieces
from estimators.core.fit import Fit
from estimators.core.results import FAILURES
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.explanation import of_part
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.loop_run import add_first
from estimators.diagnosis.model_extension import falls_clearly
from estimators.diagnosis.part_of_samples import part_of, told_by_more
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.verdict import judge
from estimators.inference.shaken_simulation import unfollowed
from estimators.output_error.fit import output_error
from estimators.validation.simulation_error import compare
from rtac_jax import RTAC
from rtac_jax.measurement import Recording


def loop_from_part(
    model: RTAC,
    train: Recording,
    loop_of: Callable[[Recording, Fit], Loop],
    policy: DiagnosisPolicy,
    *,
    progress: bool,
) -> Loop | None:
    """Return the loop over all samples that begins at the model to which a part of them leads.

    The fit and the diagnosis of the base model are of the part. None where a part leads nowhere: the recording is not long, the
    part is fitted to the noise, nothing that is named there serves held-out experiments by simulation, or all samples cannot be
    fitted with it.

    Args:
        model: the base model.
        train: the recording that is fitted.
        loop_of: gives the loop over a recording from a fit of the base model to it.
        policy: the thresholds.
        progress: show bars.
    """
    part = part_of(train)
    if part is train or model.per_experiment:
        return None
    try:
        base = output_error(model, part, progress=progress)
        if unfollowed(base, Data.of(pieces(moving(part))), policy.simulation) == 0.0:
            return None
        loop = loop_of(part, base)
        # What a part does not tell at once is asked after all samples were fitted.
        add_first(loop)
        samples = sum(e.samples for e in moving(part))
        said = loop.diagnoses[0].explanation + of_part(samples, gross=False, named=bool(loop.diagnoses[0].additions))
        loop.diagnoses[0] = dataclasses.replace(loop.diagnoses[0], explanation=said)
        if loop.out_of_time and not loop.added:  # what is named is told, of all samples fitted with the base model
            ended = loop_of(train, output_error(model, train, progress=progress))
            return dataclasses.replace(loop, train=train, part=part, steps=ended.steps)
        if not loop.added or not loop.all_simulated or _is_told_by_more(loop, train, part):
            return None
        names, last = loop.steps[-1]
        fit = output_error(last.fit.model, train, from_model=True, progress=progress)
        if fit.lost:
            return None
        tested = compare(fit, loop.held_out, labels=[last.tested.label]).models[0]
    except FAILURES:
        return None
    if not falls_clearly(loop.steps[-2][1].tested, tested, policy):
        return None
    steps = [*loop.steps[:-1], (names, dataclasses.replace(last, fit=fit, tested=tested))]
    every = "" if offered(fit.model, loop.candidates) else "Stopped: every candidate was added."
    late = loop.not_added if loop.out_of_time else ()
    return dataclasses.replace(
        loop, train=train, part=part, steps=steps, stopped=every, out_of_time=False, not_added=late
    )


def _is_told_by_more(loop: Loop, train: Recording, part: Recording) -> bool:
    """Return whether all samples would tell what was added from others that a part does not tell from it."""
    evidence = loop.diagnoses[-1].evidence
    if evidence is None or not any(c.confusable_with for c in loop.added):
        return False
    times = sum(e.samples for e in moving(train)) / sum(e.samples for e in moving(part))
    return told_by_more(evidence, judge(evidence, loop.policy), loop.policy, times)
