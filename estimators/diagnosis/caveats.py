"""Caveats of a loop's result: where its last model strays, what was added for little, and what was not added in time."""

import contextlib
import math
from collections.abc import Sequence

import numpy as np

from estimators.core.fit import Fit
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.model_extension import misfit
from estimators.diagnosis.policy import SURE, DiagnosisPolicy
from estimators.inference.robust_covariance import covariances
from estimators.linear.outlier import rounded
from estimators.validation.differing_experiments import WORTH_ASKING
from estimators.validation.simulation_error import Compared
from rtac_jax.measurement import Recording

# Times as far as what was fitted, from which a held-out experiment may show what nothing fitted does: a cubic spring twice as much.
_FARTHER = 1.25


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
        why = reaching(trained, tested) or why
    return (
        f"Even so, its simulation leaves {farthest} of the held-out experiments at {rounded(error.rms_over_noise)} times the"
        f" noise ({rounded(100 - error.fit_percent)} % of the motion), and of the fitted ones at {rounded(fitted)}: {why}."
        " est.compare(..., ahead=10) shows how far it can be followed."
    )


def reaching(trained: Compared, tested: Compared) -> str:
    """Say which held-out experiment moves farther than all that was fitted, and what to do; nothing where none does."""
    far = [{channel: 0.0 for channel in tested.errors} for _ in (trained, tested)]
    name = dict.fromkeys(tested.errors, "")
    for furthest, model in zip(far, (trained, tested), strict=True):
        for trace in model.traces:
            reach = float(np.ptp(trace.measured[np.isfinite(trace.measured)])) if trace.channel in furthest else 0.0
            if reach > furthest.get(trace.channel, 0.0):
                furthest[trace.channel] = reach
                if model is tested:
                    name[trace.channel] = trace.experiment
    fitted, held_out = far
    ratios = {channel: held_out[channel] / fitted[channel] for channel in fitted if fitted[channel] > 0}
    channel = max(ratios, key=lambda c: ratios[c], default="")
    if ratios.get(channel, 0.0) < _FARTHER:
        return ""
    return (
        f"{name[channel]} moves {ratios[channel]:.1f} times as far in {channel} as anything that was fitted, and what shows only"
        " there is missing in what is fitted without it: hold out another one (validation=, --validation)"
    )


def failure(trained: Compared, tested: Compared, *, fails: str) -> str:
    """Say how a model fails that a test rejects: at the noise only predictions one sample ahead speak against it.

    Args:
        trained: the model against the experiments that it was fitted to.
        tested: the same against those held out.
        fails: the verb where it does not end there.
    """
    worst = [max(e.rms_over_noise for e in one.errors.values()) for one in (trained, tested)]
    if all(map(at_noise, worst)):
        return f"leaves the held-out experiments at {worst[1]:.2f} times the noise, though a test of predictions rejects it"
    return fails


def of_little_service(
    first: Compared, last: Compared, count: int, policy: DiagnosisPolicy, trained: tuple[Compared, Compared]
) -> str:
    """Say that what was added serves held-out experiments little, where it does; else nothing.

    Args:
        first: the base model against the held-out experiments.
        last: the model with all that was added.
        count: effects that were.
        policy: by which fraction the error has to fall, beyond the noise, and what is most of it.
        trained: both against what they were fitted to.
    """
    before, after = misfit(first), misfit(last)
    fallen = 1 - after / before
    if not count or at_noise(before) or at_noise(after) or fallen >= policy.fall:
        return ""
    left = [misfit(one) for one in trained]
    if left[1] < policy.static * left[0]:
        return (
            f" What was fitted is left at {left[1]:.3g} times the noise instead of {left[0]:.3g}, and what was held out at"
            f" {after:.3g} instead of {before:.3g}: a model that follows nothing was near that by chance, or this one lacks more."
        )
    return (
        f" The held-out error of simulation falls by {max(100 * fallen, 0.0):.2g} % only, so {'it' if count == 1 else 'they'} may"
        " stand for something else, as a sensor that drifts or a parameter that changes."
    )


def doubtful(fit: Fit, recording: Recording, added: Sequence[Candidate]) -> tuple[str, ...]:
    """Return the ids of effects that were added and that a fit by simulation does not tell from nothing.

    Their deviations are the largest of those that the fit states, for a coloured residual, and for independent experiments.

    Args:
        fit: with the effects.
        recording: that was fitted.
        added: the effects.
    """
    amplitudes = {e.id: [f"{e.id}.{name}" for name in e.amplitudes()] for e in fit.model.effects}
    several = {c.id: amplitudes[c.id] for c in added if c.id in amplitudes}
    if not several:
        return ()
    deviations = [{name: p.std for name, p in fit.parameters.items()}]
    with contextlib.suppress(ValueError, ArithmeticError):
        spread = covariances(fit, recording)
        deviations += [spread.std("sandwich"), spread.std("clustered")]

    def sure(name: str) -> bool:
        known = [d[name] for d in deviations if np.isfinite(d.get(name, np.nan))]
        return abs(fit.parameters[name].value) > SURE * max(known, default=np.inf)

    return tuple(i for i, names in several.items() if not any(map(sure, names)))


def not_told_from_nothing(ids: Sequence[str]) -> str:
    """Say that the last fit does not tell effects from nothing; nothing where there are none."""
    if not ids:
        return ""
    return (
        f" The last fit does not tell {', '.join(ids)} from nothing, by two deviations or more: what was named so may be something"
        " else."
    )


def unsure(ids: Sequence[str], fails: str, left: float) -> str:
    """Say of effects that were added, and that a last fit far from the data does not tell from nothing, that they need not be it.

    Args:
        ids: of all that were.
        fails: subject and verb of the sentence.
        left: by the last fit, in times the noise.
    """
    named, it = ("was named and takes", "it") if len(ids) == 1 else ("were named and take", "them")
    return (
        f"{fails}, and what is missing is not known: {', '.join(ids)} {named} some of the held-out error away, but the last fit, at"
        f" {left:.3g} times the noise, does not tell {it} from nothing."
    )


def named_too_late(ids: Sequence[str]) -> str:
    """Say that effects are named and were not fitted before the time was over."""
    are, were = ("are", "were") if len(ids) > 1 else ("is", "was")
    return f"{', '.join(ids)} {are} named, and {were} not added before the time was over"
