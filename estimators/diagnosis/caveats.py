"""Caveats of a loop's result: where its last model strays, what was added for little, and what was not added in time."""

import math
from collections.abc import Sequence

from estimators.core.fit import Fit
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.model_extension import is_sure, misfit
from estimators.linear.outlier import rounded
from estimators.validation.differing_experiments import WORTH_ASKING
from estimators.validation.simulation_error import Compared


def astray(trained: Compared, tested: Compared) -> str:
    """Say where a model's simulation leaves held-out experiments although nothing is missing; nothing where it does not."""
    errors = tested.errors
    farthest = max(errors, key=lambda c: errors[c].rms_over_noise, default=None)
    if farthest is None or errors[farthest].rms_over_noise <= WORTH_ASKING:
        return ""
    error = errors[farthest]
    fitted = max((e.rms_over_noise for e in trained.errors.values()), default=math.nan)
    why = (
        "random forces, an arm that tumbles, friction that holds what a little less would not, or parameters and sensors that"
        " change within an experiment lead it away, which predictions one sample ahead do not tell apart"
    )
    if at_noise(fitted):
        why = (
            "the held-out ones may reach beyond what was fitted, differ from it in how they were recorded, or hold what no"
            " simulation follows, as an arm that tumbles"
        )
    return (
        f"Even so, its simulation leaves {farthest} of the held-out experiments at {rounded(error.rms_over_noise)} times the"
        f" noise ({rounded(100 - error.fit_percent)} % of the motion), and of the fitted ones at {rounded(fitted)}: {why}."
        " est.compare(..., ahead=10) shows how far it can be followed."
    )


def of_little_service(first: Compared, last: Compared, count: int, fall: float) -> str:
    """Say that what was added serves held-out experiments little, where it does; else nothing.

    Args:
        first: the base model against the held-out experiments.
        last: the model with all that was added.
        count: effects that were.
        fall: fraction by which the error has to fall, beyond the noise.
    """
    before, after = misfit(first), misfit(last)
    fallen = 1 - after / before
    if not count or at_noise(before) or at_noise(after) or fallen >= fall:
        return ""
    return (
        f" The held-out error of simulation falls by {max(100 * fallen, 0.0):.2g} % only, so {'it' if count == 1 else 'they'} may"
        " stand for something else, as a sensor that drifts or a parameter that changes."
    )


def not_told_from_nothing(fit: Fit, added: Sequence[Candidate]) -> str:
    """Say which effects that were added a fit does not tell from nothing; nothing where it tells all."""
    several = [c.id for c in added if c.id in fit.model and not is_sure(fit, c.id)]
    if not several:
        return ""
    return (
        f" The last fit does not tell {', '.join(several)} from nothing, by two deviations or more: what was named so may be"
        " something else."
    )


def named_too_late(ids: Sequence[str]) -> str:
    """Say that effects are named and were not fitted before the time was over."""
    are, were = ("are", "were") if len(ids) > 1 else ("is", "was")
    return f"{', '.join(ids)} {are} named, and {were} not added before the time was over"
