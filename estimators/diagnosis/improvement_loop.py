"""The loop from the base model on: diagnose, add what is named, fit again, and, at the end, last resorts."""

import contextlib
import dataclasses
from collections.abc import Sequence

from estimators.core.deadline import PROLONGED, Deadline, OutOfTimeError
from estimators.core.fit import Fit
from estimators.core.results import DivergedError
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.diagnose import diagnose
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.learned_force import LearnedForce, learn_force
from estimators.diagnosis.missing_force import static_force
from estimators.diagnosis.model_extension import (
    WAYS,
    Added,
    add_effects,
    is_sure,
    misfit,
    parameters_of,
)
from estimators.diagnosis.nearest_effect import add_nearest
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.read_law import ReadLaw, other_law, read_law, simpler_law
from estimators.diagnosis.runner_up import runner_up
from rtac_jax.effects import CATALOGUE, Effect, SplineForce
from rtac_jax.effects.one_sided_spring import GROSS
from rtac_jax.measurement import Recording

OUT_OF_TIME = "Stopped: the time that was given is over."


@dataclasses.dataclass
class Loop:
    """The loop from the base model on: diagnose, add, fit again.

    Attributes:
        train, held_out: the recording that is fitted, and the one that validates.
        candidates: classes of effects to try; None for the catalogue.
        most: effects to add at most.
        thorough: look again at what raised no alarm.
        policy: the thresholds.
        progress: show bars.
        steps: ids of what was added, with the model that has it; the first is the base model.
        diagnoses: so far.
        diagnosed: the place in `steps` of the model that each of them was made of.
        added: the effects that were added.
        stopped: why it ended.
        left_out: the experiment without which the last model was fitted; None where all were.
        deadline: after which nothing is diagnosed any more, and only what is named already is added.
        out_of_time: whether it ended for that.
        not_added: ids of what is named, and what was not fitted before.
        law_asked: the last fit beside which a law was looked for, and what came of it.
        laws: whether laws that are read off a missing force may be added.
        unseen: parameters that the base model held, as they show nowhere in its simulation; those of the last that are still held.
    """

    train: Recording
    held_out: Recording
    candidates: Sequence[type[Effect]] | None
    most: int
    thorough: bool
    policy: DiagnosisPolicy
    progress: bool
    steps: list[tuple[tuple[str, ...], Added]]
    diagnoses: list[Diagnosis] = dataclasses.field(default_factory=list)
    diagnosed: list[int] = dataclasses.field(default_factory=list)
    added: list[Candidate] = dataclasses.field(default_factory=list)
    stopped: str = ""
    left_out: str | None = None
    deadline: Deadline = dataclasses.field(default_factory=Deadline)
    out_of_time: bool = False
    not_added: tuple[str, ...] = ()
    law_asked: "tuple[Fit, Loop | None] | None" = None
    laws: bool = True
    unseen: tuple[str, ...] = ()

    @property
    def _wants_laws(self) -> bool:
        """Return whether a law may be read off a missing force before what raised no alarm is looked at again."""
        return self.laws and self.candidates is None and len(self.added) < self.most and not self.deadline.over

    @property
    def last(self) -> Added:
        """Return the last model."""
        return self.steps[-1][1]

    @property
    def held(self) -> tuple[str, ...]:
        """Return the ids of what was added and is held at the estimate of a diagnosis."""
        return tuple(name for names, step in self.steps if step.way == "held" for name in names)

    @property
    def followed(self) -> Recording:
        """Return the recording that is fitted, without the experiment that is left out."""
        if self.left_out is None:
            return self.train
        return self.train.select([e.name for e in self.train if e.name != self.left_out])

    def run(self) -> None:
        """Go on until nothing is found, or what is found does not serve held-out experiments."""
        while not self.stopped:
            if self.diagnoses and self.deadline.over:
                self.out_of_time = True
                self.stopped = OUT_OF_TIME
                return
            # What is held was estimated too: a diagnosis may move it.
            released = self.last.fit.model.release(*parameters_of(self.last.fit.model, self.held))
            base = dataclasses.replace(self.last.fit, model=released)
            try:
                found = self.diagnosed_again(base, self.candidates, thorough=self.thorough, laws_first=self._wants_laws)
            except DivergedError as error:
                if not self.diagnoses:
                    raise
                self.stopped = f"Stopped: the last model could not be diagnosed again. {error}"
                return
            self.diagnoses.append(found)
            self.diagnosed.append(len(self.steps) - 1)
            if self._add_beyond_catalogue(base, found):
                continue
            if found.awaits_law:
                with self.deadline.prolonged(PROLONGED).kept(), contextlib.suppress(OutOfTimeError):
                    if (further := self.with_law()) is not None and further.ended_adequate:
                        vars(self).update(vars(further))
                        return
                if not self.deadline.over:
                    with contextlib.suppress(DivergedError):
                        found = self.diagnoses[-1] = self.diagnosed_again(base, self.candidates, thorough=self.thorough)
            if not found.additions:
                enough = found.verdict == "adequate"
                why = "nothing more is missing" if enough else f"{found.no_effect} explains what is missing"
                if found.silent:
                    why = "nothing can be told"
                elif found.simulation is not None and found.simulation.vetoes:
                    why = "no test names what the simulation's error comes from"
                self.stopped = f"Stopped: {why}."
            self._add(found)
            if not self.stopped and not offered(self.last.fit.model, self.candidates):
                self.stopped = "Stopped: every candidate was added."

    def add_first(self) -> None:
        """Diagnose the base model, without a second look, and add what is named."""
        self.diagnoses.append(self.diagnosed_again(self.last.fit, self.candidates, thorough=False))
        self.diagnosed.append(len(self.steps) - 1)
        self._add(self.diagnoses[-1])

    def diagnosed_again(
        self, base: Fit, candidates: Sequence[type[Effect]] | None, *, thorough: bool, laws_first: bool = False
    ) -> Diagnosis:
        """Diagnose a fit of the recording that is fitted, by the options of the loop."""
        return diagnose(
            base, self.train, candidates=candidates, thorough=thorough, policy=self.policy, within=self.deadline.within,
            progress=self.progress, laws_first=laws_first,
        )  # fmt: skip

    def _add_beyond_catalogue(self, base: Fit, found: Diagnosis) -> bool:
        """Add what is in no catalogue, as it is never small, and return whether a diagnosis names it and it serves.

        Asked where a force on the cart against its position is missing, and no effect of the catalogue is it.
        """
        asked = found.verdict == "unknown" and self.candidates is None and not self.deadline.over
        if not asked or len(self.added) >= self.most:
            return False
        known = {c.id for c in found.candidates} | set(base.model.ids)
        classes = [c for i, c in GROSS.items() if i not in known]
        curve, _ = static_force(found.curves, found.tests, self.policy)
        if not classes or curve is None or (curve.port, curve.variable) != ("cart", "cart_position"):
            return False
        try:
            other = self.diagnosed_again(base, classes, thorough=False)
        except DivergedError:
            return False
        if not other.additions or self._extend_by(other.additions, other) is not None:
            return False
        self.diagnoses[-1] = other
        return True

    def _add(self, found: Diagnosis) -> None:
        """Add what a diagnosis names: together, as it was estimated, or, where no fit of that serves, one after the other."""
        several = found.additions[: max(self.most - len(self.added), 0)]
        together = self._extend_by(several, found) if len(several) > 1 else ""
        if together is not None:
            for effect in several:
                if not self.out_of_time and (reason := self._extend_by([effect], found)) is not None:
                    self.stopped = reason
                    return
        if len(several) < len(found.additions):
            self.stopped = f"Stopped: {self.most} effects were added; more seem to be missing."

    def _extend_by(self, several: Sequence[Effect], found: Diagnosis) -> str | None:
        """Add effects that a diagnosis names; return why they do not serve, or None where they do.

        Where the time is over before they are fitted, the loop ends with that.
        """
        known = {c.id: c for c in found.effects}
        ids = tuple(effect.id for effect in several)

        def extended(before: Fit) -> Added | str:
            return add_effects(
                before, self.last.tested, several, "+ " + ", ".join([*(c.id for c in self.added), *ids]), self.train,
                self.held_out, policy=self.policy, progress=self.progress,
                deviations={f"{i}.{field}": std for i in ids for field, std in known[i].deviations.items()},
                values=found.values, ways=WAYS if len(several) == 1 else WAYS[:1],
            )  # fmt: skip

        try:
            with self.deadline.prolonged(PROLONGED).kept():
                # With what was missing the simulation may show them.
                last = self.last.fit
                step = extended(dataclasses.replace(last, model=last.model.release(*self.unseen)))
                if isinstance(step, str) and self.unseen:
                    step = extended(last)
        except OutOfTimeError:
            self.out_of_time, self.not_added = True, ids
            return OUT_OF_TIME
        if isinstance(step, str):
            return step
        if found.by_simulation and step.way == "simulated":  # what simulations select has to show in one
            for unsure in (i for i in ids if not is_sure(step.fit, i)):
                return f"Stopped: fitted by simulation, {unsure} is not told from nothing."
        self.steps.append((ids, step))
        self.added += [known[i] for i in ids]
        self.unseen = tuple(name for name in self.unseen if name in step.fit.model.fixed)
        return None

    def copied(self) -> "Loop":
        """Return a loop that goes on from here by itself."""
        several = (list(x) for x in (self.steps, self.diagnoses, self.diagnosed, self.added))
        return dataclasses.replace(
            self, **dict(zip(("steps", "diagnoses", "diagnosed", "added"), several, strict=True))
        )

    def nearest(self) -> tuple[Added, Candidate] | None:
        """Return the model with the effect that explains most of what the last diagnosis cannot name, if it serves."""
        return add_nearest(
            self.last, self.diagnoses[-1], self._classes, self.train, self.held_out, policy=self.policy, progress=self.progress
        )  # fmt: skip

    def with_nearest(self, step: Added, nearest: Candidate) -> "Loop | None":
        """Return the loop that goes on with the nearest effect in the model, where that ends at an adequate one; None elsewhere.

        Two effects may hide each other: with neither in the model neither explains enough.
        """
        further = self.copied()
        further.steps.append(((nearest.id,), step))
        further.added.append(nearest)
        further.stopped = ""
        further.run()
        if not further.ended_adequate:
            return None
        beside = ", ".join(c.id for c in further.added[len(self.added) + 1 :])
        with_it = f" with {beside}" if beside else ", all parameters fitted anew,"
        further.stopped = (
            f"{nearest.id} alone explained {100 * nearest.error_reduction:.0f} % of what was left;{with_it} it explains all. "
            f"{further.stopped}"
        )
        return further

    def with_law(self) -> "Loop | None":
        """Return the loop that goes on with a law read off the missing force, where that ends at an adequate model or at the noise.

        None elsewhere, and none is read where random forces stand in for the physics, or a parameter drifts: no law that holds at
        all times is missing.
        """
        found = self.diagnoses[-1]
        curve, _ = static_force(found.curves, found.tests, self.policy)
        if curve is None or found.stands_in or found.drift or not self.all_simulated:
            return None
        if self.law_asked is not None and self.law_asked[0] is self.last.fit:
            return self.law_asked[1]
        read = read_law(
            self.last, self.added, curve, self.train, self.held_out, policy=self.policy, progress=self.progress
        )
        further = None if read is None else self._going_on(read)
        serves = further is not None and (further.ended_adequate or further.follows)
        self.law_asked = self.last.fit, further if serves else None
        return self.law_asked[1]

    def with_simpler_law(self) -> "Loop | None":
        """Return the loop that goes on with a law of fewer parameters in the place of a force, where that ends adequate as well.

        None where no law is likelier (`simpler_law`).
        """
        if not self.ended_adequate or not self.all_simulated or self.deadline.over:
            return None
        read = simpler_law(
            self.last, self.added, self.diagnoses, self.train, self.held_out, policy=self.policy, progress=self.progress
        )
        further = None if read is None else self._going_on(read)
        return further if further is not None and further.ended_adequate else None

    @property
    def follows(self) -> bool:
        """Return whether the last model follows the held-out experiments to the noise."""
        return all(at_noise(e.rms_over_noise) for e in self.last.tested.errors.values())

    @property
    def ended_adequate(self) -> bool:
        """Return whether the last diagnosis found nothing missing, and was not cut short."""
        return not self.out_of_time and self.diagnoses[-1].verdict == "adequate"

    def _going_on(self, read: ReadLaw) -> "Loop":
        """Return the loop that has gone on with a law to its end."""
        further = self.copied()
        further.steps.append(((read.law.id,), read.step))
        further.added = read.among(self.added)
        further.stopped = ""
        further.run()
        # With what else was missing in the model, another law may tell.
        if not further.ended_adequate and further.added[-1].id != read.law.id and further.all_simulated:
            other = None
            with contextlib.suppress(OutOfTimeError):
                other = other_law(
                    read, further.last, further.added, self.train, self.held_out, policy=self.policy,
                    progress=self.progress,
                )  # fmt: skip
            if other is not None:
                further.steps.append(((other.law.id,), other.step))
                further.added, further.stopped = other.among(further.added), ""
                further.run()
                read = other._replace(given_up=read.given_up)
        last = further.last if read.law.id in further.last.fit.model else read.step
        further.stopped = f"{read.said(self.last.tested, last)} {further.stopped}"
        return further

    @property
    def all_simulated(self) -> bool:
        """Return whether simulations chose all that was added: what predictions keep is not judged by simulations."""
        return all(step.way == "simulated" and step.predicted_gain is None for _, step in self.steps)

    def with_runner_up(self) -> "Loop | None":
        """Return the loop that goes on with a runner-up in the place of what was added, where simulations ask for it.

        None where none does, or where it does not end at an adequate model.
        """
        if not self.added or not self.all_simulated or self.deadline.over:
            return None
        found = runner_up(
            self.last, self.added, self.diagnoses, self._classes, self.train, self.held_out, policy=self.policy,
            progress=self.progress,
        )  # fmt: skip
        if found is None:
            return None
        further = self.copied()
        further.steps.append(((found.taken.id,), found.step))
        further.added = [c for c in self.added if c.id != found.given_up.id]
        further.added.append(dataclasses.replace(found.taken, confusable_with=()))
        further.stopped = ""
        further.run()
        if not further.ended_adequate:
            return None
        further.stopped = (
            f"{found.taken.id} takes the place of {found.given_up.id}, which predictions one sample ahead prefer: simulated, the "
            f"held-out experiments are left at {misfit(found.step.tested):.3g} times the noise, and with {found.given_up.id} at "
            f"{misfit(self.last.tested):.3g}. {further.stopped}"
        )
        return further

    def last_resort(self, near: tuple[Added, Candidate] | None) -> tuple[Candidate | None, LearnedForce | None]:
        """Add the nearest effect or a learned force, what serves held-out experiments better, and return which; None for none.

        No effect is added where random forces stand in for the physics: it may make up for a part of another mistake, and the
        simulations that it would serve are led by these forces. Neither is added where a parameter drifts: no law that holds at all
        times makes up for that.
        """
        if self.diagnoses[-1].drift:
            return None, None
        resort = learn_force(
            self.last.fit, self.last.tested, self.diagnoses[-1], self.train, self.held_out, policy=self.policy,
            progress=self.progress,
        )  # fmt: skip
        if self.diagnoses[-1].stands_in:
            near = None
        if near is not None and (isinstance(resort, str) or misfit(near[0].tested) < misfit(resort[0].tested)):
            self.steps.append(((near[1].id,), near[0]))
            return near[1], None
        if isinstance(resort, str):
            self.stopped = f"{self.stopped} {resort}"
            return None, None
        self.steps.append(((SplineForce.id,), resort[0]))
        return None, resort[1]

    @property
    def _classes(self) -> dict[str, type[Effect]]:
        return {c.id: c for c in self.candidates or CATALOGUE.values()}
