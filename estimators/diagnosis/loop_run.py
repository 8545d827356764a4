"""The loop run to its end: diagnosed and extended, with laws read off a missing force, runners-up and last resorts."""

import contextlib
import dataclasses

from estimators.core.deadline import PROLONGED, OutOfTimeError
from estimators.core.fit import Fit
from estimators.core.results import DivergedError
from estimators.diagnosis.candidate import Candidate, loudest
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement_loop import OUT_OF_TIME, Loop, classes_of
from estimators.diagnosis.learned_force import LearnedForce, learn_force
from estimators.diagnosis.missing_force import significant_equation_curves, static_force
from estimators.diagnosis.model_extension import Added, misfit, parameters_of
from estimators.diagnosis.nearest_effect import add_nearest
from estimators.diagnosis.read_law import ReadLaw, other_law, read_law, simpler_law
from estimators.diagnosis.runner_up import runner_up
from rtac_jax.effects import SplineForce
from rtac_jax.effects.one_sided_spring import GROSS


def run(loop: Loop) -> None:
    """Go on until nothing is found, or what is found does not serve held-out experiments."""
    while not loop.stopped:
        if loop.diagnoses and loop.deadline.over:
            loop.out_of_time = True
            loop.stopped = OUT_OF_TIME
            return
        # What is held was estimated too: a diagnosis may move it.
        released = loop.last.fit.model.release(*parameters_of(loop.last.fit.model, loop.held))
        base = dataclasses.replace(loop.last.fit, model=released)
        try:
            found = loop.diagnosed_again(base, loop.candidates, thorough=loop.looks_again, laws_first=loop.wants_laws)
        except DivergedError as error:
            if not loop.diagnoses:
                raise
            loop.stopped = f"Stopped: the last model could not be diagnosed again. {error}"
            return
        if (
            loop.thorough
            and not loop.looks_again
            and found.verdict == "adequate"
            and loudest(found.candidates, loop.policy)
        ):
            # So near the data no last resort is tried, but what speaks is asked for.
            found = loop.diagnosed_again(base, loop.candidates, thorough=True)
        loop.diagnoses.append(found)
        loop.diagnosed.append(len(loop.steps) - 1)
        if _add_beyond_catalogue(loop, base, found):
            continue
        if found.awaits_law:
            with loop.deadline.prolonged(PROLONGED).kept(), contextlib.suppress(OutOfTimeError):
                if (further := with_law(loop)) is not None and further.ended_adequate:
                    vars(loop).update(vars(further))
                    return
            if not loop.deadline.over:
                with contextlib.suppress(DivergedError):
                    found = loop.diagnoses[-1] = loop.diagnosed_again(base, loop.candidates, thorough=loop.looks_again)
        if not found.additions:
            enough = found.verdict == "adequate"
            why = "nothing more is missing" if enough else f"{found.no_effect} explains what is missing"
            if found.silent:
                why = "nothing can be told"
            elif found.simulation is not None and found.simulation.vetoes:
                why = "no test names what the simulation's error comes from"
            loop.stopped = f"Stopped: {why}."
        loop.add(found)
        if not loop.stopped and not offered(loop.last.fit.model, loop.candidates):
            loop.stopped = "Stopped: every candidate was added."


def add_first(loop: Loop) -> None:
    """Diagnose the base model, without a second look, and add what is named."""
    loop.diagnoses.append(loop.diagnosed_again(loop.last.fit, loop.candidates, thorough=False))
    loop.diagnosed.append(len(loop.steps) - 1)
    loop.add(loop.diagnoses[-1])


def _add_beyond_catalogue(loop: Loop, base: Fit, found: Diagnosis) -> bool:
    """Add what is in no catalogue, as it is never small, and return whether a diagnosis names it and it serves.

    Asked where a force on the cart against its position is missing, and no effect of the catalogue is it.
    """
    asked = found.verdict == "unknown" and loop.candidates is None and not loop.deadline.over
    if not asked or len(loop.added) >= loop.most:
        return False
    known = {c.id for c in found.candidates} | set(base.model.ids)
    classes = [c for i, c in GROSS.items() if i not in known]
    curve, _ = static_force(found.curves, found.tests, loop.policy)
    if not classes or curve is None or (curve.port, curve.variable) != ("cart", "cart_position"):
        return False
    try:
        other = loop.diagnosed_again(base, classes, thorough=False)
    except DivergedError:
        return False
    if not other.additions or loop.extend_by(other.additions, other) is not None:
        return False
    loop.diagnoses[-1] = other
    return True


def nearest(loop: Loop) -> tuple[Added, Candidate] | None:
    """Return the model with the effect that explains most of what the last diagnosis cannot name, if it serves."""
    return add_nearest(
        loop.last, loop.diagnoses[-1], classes_of(loop), loop.train, loop.held_out, policy=loop.policy, progress=loop.progress
    )  # fmt: skip


def with_nearest(loop: Loop, step: Added, found: Candidate) -> Loop | None:
    """Return the loop that goes on with the nearest effect in the model, where that ends at an adequate one; None elsewhere.

    Two effects may hide each other: with neither in the model neither explains enough.
    """
    further = loop.copied()
    further.steps.append(((found.id,), step))
    further.added.append(found)
    further.stopped = ""
    run(further)
    if not further.ended_adequate:
        return None
    beside = ", ".join(c.id for c in further.added[len(loop.added) + 1 :])
    with_it = f" with {beside}" if beside else ", all parameters fitted anew,"
    further.stopped = (
        f"{found.id} alone explained {100 * found.error_reduction:.0f} % of what was left;{with_it} it explains all. "
        f"{further.stopped}"
    )
    return further


def with_law(loop: Loop) -> Loop | None:
    """Return the loop that goes on with a law read off the missing force, where that ends at an adequate model or at the noise.

    None elsewhere, and none is read where a parameter drifts: no law that holds at all times is missing. Where random forces stand
    in for the physics it is the force that the equations of motion miss.
    """
    found = loop.diagnoses[-1]
    curve, _ = static_force(found.curves, found.tests, loop.policy)
    if found.stands_in:
        by_equations = significant_equation_curves(loop.last.fit.model, loop.train, loop.policy, alone=True)
        curve = by_equations[0].curve if by_equations else None
    if curve is None or found.drift or not loop.all_simulated:
        return None
    if loop.law_asked is not None and loop.law_asked[0] is loop.last.fit:
        return loop.law_asked[1]
    read = read_law(
        loop.last, loop.added, curve, loop.choosing, loop.held_out, policy=loop.policy, progress=loop.progress
    )
    step = None if read is None else loop.of_all(read.step)
    further = None if read is None or step is None else going_on(loop, read._replace(step=step))
    serves = further is not None and (further.ended_adequate or further.follows)
    loop.law_asked = loop.last.fit, further if serves else None
    return loop.law_asked[1]


def with_simpler_law(loop: Loop) -> Loop | None:
    """Return the loop that goes on with a law of fewer parameters in the place of a force, where that ends adequate as well.

    None where no law is likelier (`simpler_law`).
    """
    if not loop.ended_adequate or not loop.all_simulated or loop.deadline.over:
        return None
    read = simpler_law(
        loop.last, loop.added, loop.diagnoses, loop.train, loop.held_out, policy=loop.policy, progress=loop.progress
    )
    further = None if read is None else going_on(loop, read)
    return further if further is not None and further.ended_adequate else None


def going_on(loop: Loop, read: ReadLaw) -> Loop:
    """Return the loop that has gone on with a law to its end."""
    further = loop.copied()
    further.steps.append(((read.law.id,), read.step))
    further.added = read.among(loop.added)
    further.stopped = ""
    run(further)
    # With what else was missing in the model, another law may tell.
    if not further.ended_adequate and further.added[-1].id != read.law.id and further.all_simulated:
        other = step = None
        with contextlib.suppress(OutOfTimeError):
            other = other_law(
                read, further.last, further.added, further.choosing, loop.held_out, policy=loop.policy,
                progress=loop.progress,
            )  # fmt: skip
            step = None if other is None else further.of_all(other.step)
        if other is not None and step is not None:
            other = other._replace(step=step)
            further.steps.append(((other.law.id,), step))
            further.added, further.stopped = other.among(further.added), ""
            run(further)
            read = other._replace(given_up=read.given_up)
    last = further.last if read.law.id in further.last.fit.model else read.step
    further.stopped = f"{read.said(loop.last.tested, last)} {further.stopped}"
    return further


def with_runner_up(loop: Loop) -> Loop | None:
    """Return the loop that goes on with a runner-up in the place of what was added, where simulations ask for it.

    None where none does, or where it ends neither at an adequate model nor at the noise of what was held out.
    """
    if not loop.added or not loop.all_simulated or loop.deadline.over:
        return None
    found = runner_up(
        loop.last, loop.added, loop.diagnoses, classes_of(loop), loop.choosing, loop.held_out, policy=loop.policy,
        progress=loop.progress,
    )  # fmt: skip
    step = None if found is None else loop.of_all(found.step)
    if found is None or step is None:
        return None
    further = loop.copied()
    further.steps.append(((found.taken.id,), step))
    further.added = [c for c in loop.added if c.id != found.given_up.id]
    further.added.append(dataclasses.replace(found.taken, confusable_with=()))
    further.stopped = ""
    run(further)
    if not (further.ended_adequate or further.follows):
        return None
    further.stopped = (
        f"{found.taken.id} takes the place of {found.given_up.id}, which predictions one sample ahead prefer: simulated, the "
        f"held-out experiments are left at {misfit(step.tested):.3g} times the noise, and with {found.given_up.id} at "
        f"{misfit(loop.last.tested):.3g}. {further.stopped}"
    )
    return further


def last_resorted(loop: Loop, near: tuple[Added, Candidate] | None) -> tuple[Candidate | None, LearnedForce | None]:
    """Add the nearest effect or a learned force, what serves held-out experiments better, and return which; None for none.

    No effect is added where random forces stand in for the physics: it may make up for a part of another mistake, and the
    simulations that it would serve are led by these forces. Neither is added where a parameter drifts: no law that holds at all
    times makes up for that.
    """
    if loop.diagnoses[-1].drift:
        return None, None
    resort = learn_force(
        loop.last.fit, loop.last.tested, loop.diagnoses[-1], loop.train, loop.held_out, policy=loop.policy,
        progress=loop.progress,
    )  # fmt: skip
    if loop.diagnoses[-1].stands_in:
        near = None
    if near is not None and (isinstance(resort, str) or misfit(near[0].tested) < misfit(resort[0].tested)):
        loop.steps.append(((near[1].id,), near[0]))
        return near[1], None
    if isinstance(resort, str):
        loop.stopped = f"{loop.stopped} {resort}"
        return None, None
    loop.steps.append(((SplineForce.id,), resort[0]))
    return None, resort[1]
