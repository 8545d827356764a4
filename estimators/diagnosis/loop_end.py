"""The end of the loop: what was added is looked at again, and where the verdict is unknown, last resorts are tried."""

import contextlib
import dataclasses

from estimators.core.deadline import OutOfTimeError
from estimators.core.fit import FAR, Fit
from estimators.core.results import FAILURES, DivergedError
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.learned_force import LearnedForce
from estimators.diagnosis.loop_run import (
    last_resorted,
    nearest,
    with_law,
    with_nearest,
    with_runner_up,
    with_simpler_law,
)
from estimators.diagnosis.model_extension import Added, extended_without, falls_clearly, is_sure, misfit
from estimators.diagnosis.verdict import is_of_the_current
from estimators.linear.homogeneity_test import Equality
from estimators.output_error.fit import output_error
from estimators.prediction_error.fit import PredictorFit, prediction_error_nonlinear
from estimators.validation.differing_experiments import WORTH_ASKING, differing, may_show_alone
from estimators.validation.simulation_error import compare

_LITTLE = (
    "Less than {:.0f} % of the motion of the held-out experiments is missed, and nobody knows the noise, which a rest record would"
    " tell: no last resort is tried for so little, and not whether experiments differ."
)


@dataclasses.dataclass
class LoopEnd:
    """The loop with its last model.

    Attributes:
        loop: that goes on from the one that was ended.
        nearest, learned: the last resort of its last model, if there is one.
        differs: what differs between experiments; None where they do not.
        out_of_time: whether the deadline that is kept was over before all was asked.
        led: a fit of a model by predictions, from which no fit by simulation serves better than the one it is beside.
    """

    loop: Loop
    nearest: Candidate | None = None
    learned: LearnedForce | None = None
    differs: Equality | None = None
    out_of_time: bool = False
    led: tuple[Fit, PredictorFit] | None = None

    @property
    def by_predictions(self) -> PredictorFit | None:
        """Return the fit of the last model by predictions one sample ahead, where its simulation strays; None elsewhere."""
        if self.led is None or self.led[0] is not self.loop.last.fit:
            return None
        return self.led[1] if self.led[0].farthest > FAR or _of_the_current(self.loop) else None


def end_of(loop: Loop, *, last_resort: bool) -> LoopEnd:
    """Return the end of a loop that has run.

    Args:
        loop: that names nothing more.
        last_resort: add the nearest effect or a learned force where the verdict is unknown.
    """
    end = LoopEnd(loop)
    if loop.diagnoses[-1].silent:
        return end
    try:
        if last_resort and loop.diagnoses[-1].verdict == "unknown" and loop.is_near:
            drop_superseded(loop)
            if loop.diagnoses[-1].verdict == "unknown":
                loop.stopped = f"{loop.stopped} {_LITTLE.format(100 * loop.policy.consequence)}"
            return end
        end.differs = _instead_of_effects(loop)
        if end.differs is not None:
            return end
        _look_again(end)
        _resort(end, last_resort=last_resort)
    except OutOfTimeError:
        end.out_of_time = True
    return end


def _instead_of_effects(loop: Loop) -> Equality | None:
    """Return what differs between experiments, and take back what was added, if that follows all to the noise and this does not.

    None elsewhere. What goes with the motion is sooner an effect. A spring that softens from run to run, and friction that falls,
    was an `end_stop`, with which a simulation was left at 7 times the noise.
    """
    last = loop.last.fit
    if not loop.added or last.farthest <= WORTH_ASKING or loop.deadline.over:
        return None
    found = differing(loop.steps[0][1].fit, loop.train, coloured=loop.diagnoses[0].coloured)
    if found is None or not found.is_of_the_rig:
        return None
    names = ", ".join(c.id for c in loop.added)
    loop.stopped = (
        f"Not kept: {names}, with which a simulation is left at {last.farthest:.3g} times the noise; where each experiment has "
        f"its own {' and '.join(found.varying)}, without it, at {max(found.over_noise.values()):.3g}."
    )
    loop.added, loop.unseen = [], ()
    for several in (loop.steps, loop.diagnoses, loop.diagnosed):
        del several[1:]
    return found


def _look_again(end: LoopEnd) -> None:
    """Fit what simulates far off from elsewhere, or with a runner-up, leave out what others supersede, and try simpler laws."""
    led = lead_by_predictions(end.loop)
    end.led = None if led is None else (end.loop.last.fit, led)
    end.loop = with_runner_up(end.loop) or end.loop
    drop_superseded(end.loop)
    end.loop = with_simpler_law(end.loop) or end.loop


def _of_the_current(loop: Loop) -> bool:
    """Return whether the noise of a measured current leads the last simulation astray, as far as it does."""
    told = loop.diagnoses[-1]
    found = told.simulation
    if found is None or found.cause != "shaken" or told.evidence is None:
        return False
    return is_of_the_current(told.evidence.facts, (found.random_force, found.random_torque), loop.policy)


def lead_by_predictions(loop: Loop) -> PredictorFit | None:
    """Fit the last model anew from where predictions one sample ahead lead, if it is adequate to these and simulates far off.

    Its fit by simulation may have ended in another minimum. Kept where most of the held-out error falls.

    Returns:
        the fit by predictions, where no fit by simulation from there serves better; None elsewhere, and where none was asked.
    """
    last = loop.last
    far = max(e.rms_over_noise for e in last.tested.errors.values()) > FAR or _of_the_current(loop)
    adequate = loop.diagnoses[-1].verdict == "adequate"
    if not far or not loop.all_simulated or not adequate or loop.deadline.over:
        return None
    try:
        led = prediction_error_nonlinear(last.fit.model, loop.train, from_model=True, progress=loop.progress)
    except FAILURES:
        return None
    try:
        fit = output_error(led.model, loop.train, from_model=True, progress=loop.progress)
        tested = compare(fit, loop.held_out, labels=[last.tested.label]).models[0]
    except FAILURES:
        return led
    if fit.lost or misfit(tested) > (1 - loop.policy.static) * misfit(last.tested):
        return led
    loop.steps[-1] = loop.steps[-1][0], dataclasses.replace(last, fit=fit, tested=tested)
    loop.stopped = (
        f"The last model is fitted again from where predictions lead: the held-out experiments were left at "
        f"{misfit(last.tested):.3g} times the noise, and are at {misfit(tested):.3g}. {loop.stopped}"
    )
    return None


def _resort(end: LoopEnd, *, last_resort: bool) -> None:
    """Ask whether experiments differ, and where the verdict is unknown, add what explains most, if it serves."""
    loop = end.loop
    unknown, asked = loop.diagnoses[-1].verdict == "unknown", loop.last.fit
    whole = loop.copied()
    # One that differs is left out only where all that may explain it was asked.
    leave = not loop.diagnoses[-1].broken_off
    end.differs = without_outlier(loop, least=0.0 if unknown else WORTH_ASKING, leave=leave)
    if last_resort and unknown and loop.left_out is not None:
        # Unless a last resort that is learned from all serves held-out experiments better: then it alone may show what is missing.
        try:
            resort = last_resorted(whole, nearest(whole))
        except OutOfTimeError:
            end.loop = whole
            raise
        if falls_clearly(loop.last.tested, whole.last.tested, loop.policy):
            end.loop, (end.nearest, end.learned) = whole, resort
            end.differs = without_outlier(whole, leave=False)
    elif last_resort and unknown and end.differs is not None and end.differs.is_of_the_rig:
        return  # no law that holds in all of them makes up for that
    elif last_resort and unknown:
        end.loop = with_law(loop) or loop
        near = nearest(loop) if end.loop is loop else None
        further = None if near is None else with_nearest(loop, *near)
        if further is not None:
            end.loop = further
        elif end.loop is loop:
            end.nearest, end.learned = last_resorted(loop, near)
        if end.loop.last.fit is not asked:
            # What a last resort learned from all of them explains is no fault of one.
            kept = end.differs if end.differs is not None and end.differs.outlying is None else None
            end.differs = None
            end.differs = without_outlier(end.loop, leave=False) or kept


def without_outlier(loop: Loop, *, least: float = WORTH_ASKING, leave: bool = True) -> Equality | None:
    """Return what differs between experiments; fit without the one that does alone, if that serves.

    It does where nothing is named, that experiment cannot be the one that alone shows what the model lacks
    (`may_show_alone`), and the held-out experiments do not lose by it.

    Args:
        loop: that has run.
        least: residual over noise of the last fit, from which it is asked; by default several times the noise.
        leave: fit without the one; else it is only told.
    """
    found = differing(loop.last.fit, loop.train, least=least, coloured=loop.diagnoses[-1].coloured)
    one = None if found is None else found.outlying
    if one is None or not one.decisive or one.fit is None:
        return found
    label = (
        f"without {one.name}" if loop.last.tested.label == "base" else f"{loop.last.tested.label}, without {one.name}"
    )
    tested = compare(one.fit, loop.held_out, labels=[label]).models[0]
    # What was named may rest on that experiment.
    named = loop.added or loop.diagnoses[-1].additions
    if leave and not named and not may_show_alone(loop.train, one) and misfit(tested) <= misfit(loop.last.tested):
        loop.steps.append(((), Added(one.fit, tested, "held" if loop.last.way == "held" else "simulated")))
        loop.left_out = one.name
    return found


def drop_superseded(loop: Loop) -> None:
    """Leave out what was added and of which little is left beside the others, or which the held-out experiments refuse.

    The latter is asked of what was added at once, where the simulation of held-out experiments stays far off.
    """
    for candidate in tuple(loop.added) if len(loop.added) > 1 else ():
        last, others, together = loop.last, [c for c in loop.added if c is not candidate], loop.steps[-1][0]
        needed = any(candidate.id in effect.only_beside for effect in last.fit.model.effects)
        far = max(e.rms_over_noise for e in last.tested.errors.values()) > FAR and len(together) > 1
        gone = candidate is not loop.added[-1] and _is_gone(loop, candidate)
        if needed or not (gone or (far and candidate.id in together)) or not loop.all_simulated or loop.deadline.over:
            continue
        label = "+ " + ", ".join(c.id for c in others)
        step = extended_without(
            last, [candidate.id], [], label, loop.choosing, loop.held_out, progress=loop.progress
        )  # fmt: skip
        if loop.choosing is not loop.train and _serves(loop, step, gone=gone)[0]:
            step = None if step is None else extended_without(
                step, [], [], label, loop.train, loop.held_out, progress=loop.progress
            )  # fmt: skip
        serves, refused = _serves(loop, step, gone=gone)
        if step is None or not serves:
            continue
        loop.steps[-1], loop.added = (tuple(i for i in together if i != candidate.id), step), others
        why = "the held-out error falls without it" if refused else "nothing is left of it"
        loop.stopped = (
            f"{candidate.id} is left out again: beside {', '.join(c.id for c in others)} {why}. {loop.stopped}"
        )
        if refused:  # the last diagnosis is to be of the model that is left
            with contextlib.suppress(DivergedError):
                loop.diagnoses.append(loop.diagnosed_again(step.fit, loop.candidates, thorough=False))
                loop.diagnosed.append(len(loop.steps) - 1)


def _serves(loop: Loop, step: Added | None, *, gone: bool) -> tuple[bool, bool]:
    """Return whether a model with an effect less may take the last one's place, and whether the held-out error asks for it.

    Args:
        loop: with the last model.
        step: the model with an effect less, if it could be fitted.
        gone: whether little is left of the effect.
    """
    before = misfit(loop.last.tested)
    left = float("inf") if step is None else misfit(step.tested)
    refused = left <= (1 - loop.policy.fall) * before
    lost = left > max((1 + loop.policy.fall) * before, 1.0)
    return refused or (gone and not lost), refused


def _is_gone(loop: Loop, candidate: Candidate) -> bool:
    """Return whether the last fit leaves little of an effect: next to nothing of its size when it was named, or of any."""
    if not is_sure(loop.last.fit, candidate.id):
        return True
    names = next(effect for effect in loop.last.fit.model.effects if effect.id == candidate.id).amplitudes()
    sizes = [(loop.last.fit.parameters[f"{candidate.id}.{n}"].value, candidate.parameters[n].value) for n in names]
    return all(abs(now) <= loop.policy.left * abs(named) for now, named in sizes)
