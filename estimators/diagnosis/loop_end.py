"""The end of the loop: what was added is looked at again, and where the verdict is unknown, last resorts are tried."""

from typing import NamedTuple

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.learned_force import LearnedForce
from estimators.diagnosis.model_extension import falls_clearly
from estimators.linear.homogeneity_test import Equality
from estimators.validation.differing_experiments import WORTH_ASKING


class LoopEnd(NamedTuple):
    """The loop with its last model.

    Attributes:
        loop: that goes on from the one that was ended.
        nearest, learned: the last resort of its last model, if there is one.
        differs: what differs between experiments; None where they do not.
    """

    loop: Loop
    nearest: Candidate | None
    learned: LearnedForce | None
    differs: Equality | None


def end_of(loop: Loop, *, last_resort: bool) -> LoopEnd:
    """Return the end of a loop that has run.

    Args:
        loop: that names nothing more.
        last_resort: add the nearest effect or a learned force where the verdict is unknown.
    """
    loop.lead_by_predictions()
    loop = loop.with_runner_up() or loop
    loop.drop_superseded()
    nearest, learned = None, None
    unknown, asked = loop.diagnoses[-1].verdict == "unknown", loop.last.fit
    whole = loop.copied()
    differs = loop.without_outlier(least=0.0 if unknown else WORTH_ASKING)
    if last_resort and unknown and loop.left_out is not None:
        # Unless a last resort that is learned from all serves held-out experiments better: then it alone may show what is missing.
        resort = whole.last_resort(whole.nearest())
        if falls_clearly(loop.last.tested, whole.last.tested, loop.policy):
            loop, (nearest, learned) = whole, resort
            differs = loop.without_outlier(leave=False)
    elif last_resort and unknown:
        near = loop.nearest()
        further = None if near is None else loop.with_nearest(*near)
        if further is not None:
            loop = further
        else:
            nearest, learned = loop.last_resort(near)
        if loop.last.fit is not asked:
            # What a last resort learned from all of them explains is no fault of one.
            kept = differs if differs is not None and differs.outlying is None else None
            differs = loop.without_outlier(leave=False) or kept
    return LoopEnd(loop, nearest, learned, differs)
