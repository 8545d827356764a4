"""The laboratory of a diagnosis: what a selection may ask to be computed, answered from saved evidence here."""

from collections.abc import Mapping, Sequence
from typing import Literal, Protocol, runtime_checkable

from estimators.diagnosis.evidence import Evidence, Facts, FittedModel, HeldOut, SimulationError
from estimators.misspecification.findings import Findings, Score

Way = Literal["filter", "thorough", "equations", "simulation"]
"""To refit a model with a candidate: from the shape that was screened, from wherever a refit may begin, from where the equations of
motion put it, or from where a fitted simulation ends."""


@runtime_checkable
class Laboratory(Protocol):
    """The answers to a selection's questions; None, or a refit left out, where a model diverges or no answer is known."""

    @property
    def facts(self) -> Facts:
        """About the recording."""
        ...

    @property
    def base(self) -> FittedModel:
        """Return the base model."""
        ...

    def say(self, text: str) -> None:
        """Tell what is asked now."""
        ...

    def first_refits(
        self, before: FittedModel, first: Score, near: Sequence[Score], way: Way
    ) -> dict[str, FittedModel]:
        """Refit a model with the first candidate and those near it, each by itself; the findings of the first are asked next."""
        ...

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        """Refit a model with each of several candidates."""
        ...

    def unfitted(self, before: FittedModel) -> tuple[str, ...]:
        """Return the candidates whose refits beside a model were broken off, as the time was over."""
        ...

    def findings(self, model: FittedModel) -> Findings | None:
        """Test the innovations of a model."""
        ...

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates against a predictor with low process noise."""
        ...

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates by what they take off the equation error of a model, those that a forward selection takes first."""
        ...

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        """Return what an effect gains where it was not estimated."""
        ...

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        """Return the base model with coloured noise, if the data are likelier with it, and may be than with another model."""
        ...

    def simulation(self, model: FittedModel) -> SimulationError | None:
        """Return the error of a free simulation of a model."""
        ...

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        """Return the rms error over the noise, by channel, that a simulation fitted with each of several candidates leaves."""
        ...


class Archive:
    """A laboratory that answers from evidence, and notes what the evidence has no answer to.

    Attributes:
        missing: what was asked and never computed.
    """

    def __init__(self, evidence: Evidence) -> None:
        self.facts = evidence.facts
        self.base = evidence.models[0]
        self.missing = [f"{one}, as the time was over" for one in evidence.broken_off]
        self._evidence = evidence
        self._models = {model.number: model for model in evidence.models}
        self._refits = {(one.before, one.way, one.effect): one.after for one in evidence.refits}

    def say(self, text: str) -> None:
        """Say nothing: nobody waits."""

    def first_refits(
        self, before: FittedModel, first: Score, near: Sequence[Score], way: Way
    ) -> dict[str, FittedModel]:
        """Return the refits with the first candidate and those near it."""
        return self.refits(before, [first, *near], way)

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        """Return the refits with each of several candidates."""
        found = {s.id: self._refit(before, way, s.id) for s in several}
        return {effect: model for effect, model in found.items() if model is not None}

    def unfitted(self, before: FittedModel) -> tuple[str, ...]:
        """Return the candidates whose refits beside a model were broken off, as the time was over."""
        return self._evidence.unfitted.get(before.number, ())

    def findings(self, model: FittedModel) -> Findings | None:
        """Return the tests of the innovations of a model."""
        if model.number not in self._evidence.findings:
            self._note(f"tests of the model with {_named(model)}")
        return self._evidence.findings.get(model.number)

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Return the scores of candidates against a predictor with low process noise."""
        if model.number not in self._evidence.quiet:
            self._note(f"scores with low process noise of the model with {_named(model)}")
        return self._evidence.quiet.get(model.number, ())

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Return the scores of candidates by what they take off the equation error of a model."""
        if model.number not in self._evidence.equations:
            self._note(f"equation error of the model with {_named(model)}")
        return self._evidence.equations.get(model.number, ())

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        """Return what an effect gains where it was not estimated."""
        key = before.number, after.number
        if key not in self._evidence.held_out:
            self._note(f"held-out gain of the model with {_named(after)}")
        return self._evidence.held_out.get(key, HeldOut((), ()))

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        """Return the base model with coloured noise, if the data are likelier with it, and may be than with another model."""
        if not self._evidence.colour_asked:
            self._note("base model with coloured noise")
        return None if self._evidence.coloured is None else self._models[self._evidence.coloured]

    def simulation(self, model: FittedModel) -> SimulationError | None:
        """Return the error of a free simulation of a model."""
        if model.number not in self._evidence.simulations:
            self._note(f"simulation of the model with {_named(model)}")
        return self._evidence.simulations.get(model.number)

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        """Return the rms error over the noise, by channel, that a simulation fitted with each of several candidates leaves."""
        known = {s.id: (before.number, s.id) for s in several}
        for effect, key in known.items():
            if key not in self._evidence.simulated:
                self._note(f"simulation with {effect} beside the model with {_named(before)}")
        found = {effect: self._evidence.simulated.get(key) for effect, key in known.items()}
        return {effect: errors for effect, errors in found.items() if errors}

    def _refit(self, before: FittedModel, way: str, effect: str) -> FittedModel | None:
        key = before.number, way, effect
        if key not in self._refits:
            self._note(f"{way} refit of {effect} to the model with {_named(before)}")
            return None
        after = self._refits[key]
        return None if after is None else self._models[after]

    def _note(self, what: str) -> None:
        if what not in self.missing:
            self.missing.append(what)


def _named(model: FittedModel) -> str:
    return ", ".join(model.added) or "nothing added"
