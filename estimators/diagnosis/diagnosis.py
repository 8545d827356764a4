"""The result of a diagnosis: the verdict, its effects, and everything that it rests on."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from estimators.core.drawing import draw
from estimators.core.result_base import Result
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.explanation import BEGIN_ELSEWHERE, MOVE_IT, at_noise, floor_of
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.removed_error import Verdict
from estimators.diagnosis.verdict import Consequence
from estimators.inference.simulation_residual import SimulationResidual
from estimators.misspecification.adequacy import AdequacyTest, excess_of
from estimators.misspecification.line_classes import LineClass
from estimators.misspecification.residual_maps import Place
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.latent_force import LatentForce
from rtac_jax.effects import Effect
from rtac_jax.measurement import OUTPUTS
from rtac_jax.overview import Overview, shortened


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis(Result):
    """The result of `diagnose`.

    Attributes:
        verdict: "adequate", "missing", "ambiguous" or "unknown".
        effects: the accepted candidates, first found first; for "ambiguous" also the rivals that the data cannot tell
            apart from them.
        additions: the effects to be added to the model, at their estimated parameters.
        candidates: all, best first.
        tests: of whether anything is missing in the base model.
        left: the same tests after the additions.
        removed: fraction of the misfit that the additions remove.
        curves: missing force at each port against each variable, best first.
        latent: missing force at each port in time, where the verdict is unknown.
        places: where the innovations are too large, worst first.
        lines: innovations by class of spectral line, where an input is periodic.
        random_force, random_torque: what the predictor of the base model needs, as fractions of the rms forces.
        explanation: in plain words.
        seconds: how long it took.
        simulation: what the error of the fitted simulation means, where no test rejects and no effect is named, or where beside
            the effects that would be named random forces still stand in for the physics, so that none is; None elsewhere.
        policy: the thresholds that it was judged by.
        consequence: what the effects, or those that are detectable, take off the error; None where there are none.
        detectable: candidates that the data show, but without which the model is adequate: they take next to nothing off the error.
        evidence: everything that was computed, to be saved, or judged by another policy; None where the result was made by hand.
        simulated: residual of the diagnosed fit's simulation over the noise, of the worst channel; over coloured noise where that
            was assumed.
        coloured: rms of coloured noise that was assumed without a record at rest, by channel, where it is credible.
        by_simulation: whether the effects were selected by what they take off the simulation's error, which `removed` then counts.
        rounded: quantisation step of the channels whose noise is next to nothing but rounding, SI units.
        values: of all parameters that the predictor with the additions estimates, SI units.
        broken_off: what was asked and not computed, as the time that was given was over: candidates by id, and what else.
        awaits_law: whether a force of one variable explains nearly all that is missing, and what raised no alarm was not looked at
            again for that (`laws_first`).
        nearest_simulated: where nothing is named although the simulation fails, the candidates that take most of its squared error
            beyond the noise off (`error_reduction`), as simulations with them estimate them, the nearest first.
    """

    verdict: Verdict
    effects: tuple[Candidate, ...]
    additions: tuple[Effect, ...]
    candidates: tuple[Candidate, ...]
    tests: tuple[AdequacyTest, ...]
    left: tuple[AdequacyTest, ...]
    removed: float
    curves: tuple[ForceCurve, ...]
    latent: tuple[LatentForce, ...]
    places: tuple[Place, ...]
    lines: tuple[LineClass, ...]
    random_force: float
    random_torque: float
    explanation: str
    seconds: float
    simulation: SimulationResidual | None = None
    policy: DiagnosisPolicy = STANDARD
    evidence: Evidence | None = None
    consequence: Consequence | None = None
    detectable: tuple[Candidate, ...] = ()
    simulated: float = 0.0
    coloured: Mapping[str, float] = dataclasses.field(default_factory=dict)
    by_simulation: bool = False
    rounded: Mapping[str, float] = dataclasses.field(default_factory=dict)
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    broken_off: tuple[str, ...] = ()
    awaits_law: bool = False
    nearest_simulated: tuple[Candidate, ...] = ()

    @property
    def misfit(self) -> str:
        """Return what `removed` is a fraction of, in words."""
        return "the simulation's squared error beyond the noise" if self.by_simulation else "the misfit"

    @property
    def stands_in(self) -> bool:
        """Return whether random forces stand in for the physics, of the model or of the one with what would be named."""
        return self.simulation is not None and self.simulation.cause == "stand-in"

    @property
    def silent(self) -> str:
        """Return that nothing can be told of what the model lacks, in words, where that is so; empty elsewhere."""
        if self.verdict != "unknown" or self.evidence is None:
            return ""
        facts = self.evidence.facts
        if not (facts.silent or facts.stuck) or any(test.rejects for test in self.tests):
            return ""
        if facts.stuck:
            return (
                "Nothing can be told of what the model lacks: cart or arm all but rests in its fit for"
                f" {100 * facts.left_out:.0f} % of the samples, which do not count, and its simulation misses"
                f" {100 * min(facts.unfollowed, 1.0):.0f} % of the motion"
            )
        return (
            f"These data say nothing of what the model lacks: {100 * facts.left_out:.0f} % of the samples do not"
            " count, as the cart or the arm all but rests there, and no effect of any plausible size would show"
        )

    @property
    def silent_mend(self) -> str:
        """Return what to do where nothing can be told; empty elsewhere."""
        if not self.silent or self.evidence is None:
            return ""
        return BEGIN_ELSEWHERE if self.evidence.facts.stuck else MOVE_IT

    @property
    def colour_told(self) -> Mapping[str, float]:
        """Return the coloured noise that errors are held against: where nothing is missing, or what rejects may be a sensor's.

        Of a model that fails it may stand for what is missing.
        """
        return self.coloured if self.verdict == "adequate" or self.line_alone or self.rounding else {}

    @property
    def line_alone(self) -> str:
        """Return the words of the test that rejects, where that is of a spectral line and the simulation is at the noise."""
        rejecting = [test for test in self.tests if test.rejects]
        alone = [test.test for test in rejecting] == ["spectral line"] and at_noise(self.simulated)
        return rejecting[0].words if self.verdict == "unknown" and alone else ""

    @property
    def rounding(self) -> str:
        """Return what may reject a model whose simulation is at the noise: the rounding of sensors, in words; empty elsewhere."""
        rejecting = [test for test in self.tests if test.rejects]
        if self.verdict != "unknown" or not self.rounded or not rejecting or not at_noise(self.simulated):
            return ""
        steps = " and ".join(
            f"{channel} in steps of {step:.2g} {OUTPUTS[channel]}" for channel, step in self.rounded.items()
        )
        worst = max(rejecting, key=lambda test: test.excess)
        return f"{steps}, whose rounding is no random noise; {worst.words}"

    @property
    def slight(self) -> bool:
        """Return whether only predictions one sample ahead speak against a model whose simulation is at a noise that is known."""
        known = self.evidence is not None and self.evidence.facts.noise_known
        return self.verdict == "unknown" and known and at_noise(self.simulated)

    @property
    def drift(self) -> str:
        """Return the words of the test of drift, where it rejects and what any other finds is a small part of that.

        What grows with the amplitude, as a spring that hardens, changes in free decays with the time as well.
        """
        return _drift(self, self.policy.left)

    @property
    def likely_drift(self) -> str:
        """Return the words of the test of drift, where any other finds half of what it does at most, but not next to nothing."""
        return "" if self.drift else _drift(self, self.policy.static)

    @property
    def no_effect(self) -> str:
        """Return the subject of a sentence that says that nothing explains a misfit."""
        return "no effect that was fitted before the time was over" if self.broken_off else "no effect of the catalogue"

    @property
    def best(self) -> Effect | None:
        """Return the first effect to be added; None if there is none."""
        return self.additions[0] if self.additions else None

    @property
    def floor(self) -> str:
        """Return down to where nothing is missing, of an adequate model: the noise, or predictions that count random forces."""
        return floor_of(max(self.random_force, self.random_torque), self.simulated)

    def overview(self) -> Overview:
        """Return the verdict with the parameters of what was accepted, and the beginning of the explanation."""
        rows = [
            (c.id, name, f"{p.value:.4g}", f"{p.std:.2g}", p.unit)
            for c in self.effects
            for name, p in c.parameters.items()
        ]
        named = f" ({', '.join(c.id for c in self.effects)})" if self.effects else ""
        header = ("effect", "parameter", "value", "std", "unit") if rows else ()
        return Overview(f"{self.verdict}{named}", header, rows, (shortened(self.explanation),))

    def __str__(self) -> str:
        lines = [self.explanation, ""]
        lines.append(f"{'candidate':22s} {'score':>10s} {'p':>9s} {'BIC gain':>10s} {'removes':>8s}  detection limit")
        for c in self.candidates:
            gain = f"{c.bic_gain:10.1f}" if c.refitted else " " * 10
            removes = f"{100 * c.error_reduction:7.0f}%" if c.refitted else " " * 8
            lines.append(f"{c.id:22s} {c.score:10.1f} {c.p_value:9.2g} {gain} {removes}  {c.limit_or_why}")
        lines.append("score: chi-square of predictions one sample ahead, less the price of the parameters")
        lines.append("")
        for title, tests in (("base model", self.tests), ("with what was added", self.left if self.additions else ())):
            for test in tests:
                said = "rejects" if test.rejects else "passes"
                lines.append(f"{title}: {test.test} {said} (p = {test.p_value:.2g}): {test.words}")
        lines += ["", self.policy.words]
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw a bar chart of the candidates and the missing-force curve, as a matplotlib figure."""
        return draw(self)


def _drift(found: Diagnosis, most: float) -> str:
    """Return the words of the test of drift, where any other finds this fraction of what it does at most."""
    if found.verdict != "unknown":
        return ""
    drift = next((test for test in found.left if test.test == "drift" and test.rejects), None)
    others = excess_of([test for test in found.left if test.test != "drift"])
    return "" if drift is None or others > most * drift.excess else drift.words
