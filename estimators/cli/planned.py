"""The experiment that would tell the effects of an ambiguous diagnosis apart, in a report."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from estimators.cli.job import Job

if TYPE_CHECKING:
    from estimators.core.fit import Fit
    from estimators.diagnosis.diagnosis import Diagnosis
    from estimators.experiment_design.next_experiment import NextExperiment
    from rtac_jax.effects import Effect


def plan_next(work: Job, base: "Fit", found: "Diagnosis", candidates: "Sequence[type[Effect]] | None") -> Any:
    """Plan the experiment that would tell the effects of an ambiguous diagnosis apart.

    None where none is needed or feasible, or none would tell them apart, as an effect and a wrong constant.
    """
    import estimators as est
    from estimators.diagnosis.wrong_constant import without_constants

    groups = [(c.id, *c.confusable_with) for c in found.effects if c.confusable_with]
    if found.verdict != "ambiguous" or not any(map(without_constants, groups)):
        return None

    try:
        planned = est.next_experiment(base, work.train, found, candidates=candidates, held_out=work.held_out)
    except (ValueError, FloatingPointError) as error:
        work.note(f"No next experiment could be planned: {error}")
        return None
    if planned.hopeless:
        work.note(planned.hopeless)
        return None
    return planned


def show_plan(planned: "NextExperiment | None", work: Job, figures: dict[str, Any], captions: dict[str, str]) -> None:
    """Write the recommended experiment for the rig, and add its picture to those of a report."""
    if planned is None or work.folder is None:
        return
    planned.save(work.folder / "next_experiment.h5")
    figures["next_experiment"] = planned.plot()
    said = "What would tell them apart; next_experiment.h5 can be played on the rig."
    captions["next_experiment"] = f"{said} {planned.spared}".strip()
