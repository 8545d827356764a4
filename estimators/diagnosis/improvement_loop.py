"""The loop from the base model on: diagnose, add what is named, fit again, and, at the end, last resorts."""

import dataclasses
from collections.abc import Sequence

from estimators.core.deadline import PROLONGED, Deadline, OutOfTimeError
from estimators.core.fit import Fit
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnose import diagnose
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.explanation import at_noise
from estimators.diagnosis.model_extension import (
    WAYS,
    Added,
    add_effects,
    extended_without,
    falls_clearly,
    is_sure,
)
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.inference.simulation_residual import judged_channels
from rtac_jax.effects import CATALOGUE, Effect
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
        part: of a long recording, that shows as much; None of another.
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
    part: Recording | None = None
    unseen: tuple[str, ...] = ()

    @property
    def wants_laws(self) -> bool:
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

    def diagnosed_again(
        self, base: Fit, candidates: Sequence[type[Effect]] | None, *, thorough: bool, laws_first: bool = False
    ) -> Diagnosis:
        """Diagnose a fit of the recording that is fitted, by the options of the loop."""
        return diagnose(
            base, self.train, candidates=candidates, thorough=thorough, policy=self.policy, within=self.deadline.within,
            progress=self.progress, laws_first=laws_first,
        )  # fmt: skip

    def add(self, found: Diagnosis) -> None:
        """Add what a diagnosis names: together, as it was estimated, or, where no fit of that serves, one after the other."""
        several = found.additions[: max(self.most - len(self.added), 0)]
        together = self.extend_by(several, found) if len(several) > 1 else ""
        if together is not None:
            for effect in several:
                if not self.out_of_time and (reason := self.extend_by([effect], found)) is not None:
                    self.stopped = reason
                    return
        if len(several) < len(found.additions):
            self.stopped = f"Stopped: {self.most} effects were added; more seem to be missing."

    def extend_by(self, several: Sequence[Effect], found: Diagnosis) -> str | None:
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
                unseen=[name for name in self.unseen if name in before.model.fixed],
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
        self.unseen = tuple(name for name in self.unseen if name in step.fit.model.fixed)
        self.steps.append((ids, step))
        self.added += [known[i] for i in ids]
        return None

    def copied(self) -> "Loop":
        """Return a loop that goes on from here by itself."""
        several = (list(x) for x in (self.steps, self.diagnoses, self.diagnosed, self.added))
        return dataclasses.replace(
            self, **dict(zip(("steps", "diagnoses", "diagnosed", "added"), several, strict=True))
        )

    @property
    def follows(self) -> bool:
        """Return whether the last model follows the held-out experiments to the noise."""
        return all(at_noise(e.rms_over_noise) for e in self.last.tested.errors.values())

    @property
    def is_near(self) -> bool:
        """Return whether less than `DiagnosisPolicy.consequence` of any held-out motion is missed with what was added.

        And nobody knows the noise, beside which so little may be much: it may be the noise.
        """
        if not self.added:
            return False
        missed = (1 - e.fit_percent / 100 for e in self.last.tested.errors.values())
        near = all(one < self.policy.consequence for one in missed)
        return near and not judged_channels(self.last.fit.residual_std, self.train)[1]

    @property
    def looks_again(self) -> bool:
        """Return whether the next diagnosis looks again at what raised no alarm; not where nothing is tried for what is left."""
        return self.thorough and not self.is_near

    @property
    def ended_adequate(self) -> bool:
        """Return whether the last diagnosis found nothing missing, and was not cut short."""
        return not self.out_of_time and self.diagnoses[-1].verdict == "adequate"

    @property
    def choosing(self) -> Recording:
        """Return the recording by which one of several models is chosen: a part of a long one, of which all is fitted then."""
        return self.train if self.part is None or self.last.fit.model.per_experiment else self.part

    def of_all(self, step: Added) -> Added | None:
        """Return a model that a part of the samples chose, fitted to all of them; None where it no longer serves better."""
        if self.choosing is self.train:
            return step
        fitted = extended_without(step, [], [], step.tested.label, self.train, self.held_out, progress=self.progress)
        serves = fitted is not None and falls_clearly(self.last.tested, fitted.tested, self.policy)
        return fitted if serves else None

    @property
    def all_simulated(self) -> bool:
        """Return whether simulations chose all that was added: what predictions keep is not judged by simulations."""
        return all(step.way == "simulated" and step.predicted_gain is None for _, step in self.steps)


def classes_of(loop: Loop) -> dict[str, type[Effect]]:
    """Return the classes of a loop's candidates by id."""
    return {c.id: c for c in loop.candidates or CATALOGUE.values()}
