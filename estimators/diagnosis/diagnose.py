"""Diagnosis of the missing effect: candidates ranked on a predictor's innovations, refitted, judged, and added."""

import dataclasses
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from tqdm import tqdm

from estimators.core.compilation import Ahead, make_room
from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.diagnosis.candidate import Candidate, Step
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.choice import bic_gain, gain
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.refitting import Search
from estimators.diagnosis.stepwise_selection import Tried, by_size, improvements, second_looks
from estimators.diagnosis.verdict import (
    SHAKEN,
    Verdict,
    floor,
    judge,
    not_named,
    shaken,
    strayed,
    surer,
    without_named_rivals,
    without_the_physics,
    words,
)
from estimators.diagnosis.wrong_constant import doubt
from estimators.inference.simulation_residual import SimulationResidual
from estimators.misspecification.adequacy import Evidence, alarming, excess_of, p_by_chance
from estimators.misspecification.candidate_screening import correlations
from estimators.misspecification.detection_limit import TESTABLE, main_amplitude
from estimators.misspecification.line_classes import LineClass
from estimators.misspecification.residual_maps import Place
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.latent_force import LatentForce
from rtac_jax import RTAC, require_configured
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording
from rtac_jax.parameters import declarations


@dataclasses.dataclass(frozen=True)
class Diagnosis:
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
    """

    verdict: Verdict
    effects: tuple[Candidate, ...]
    additions: tuple[Effect, ...]
    candidates: tuple[Candidate, ...]
    tests: tuple[Evidence, ...]
    left: tuple[Evidence, ...]
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

    @property
    def best(self) -> Effect | None:
        """The first effect to be added; None if there is none."""
        return self.additions[0] if self.additions else None

    def __str__(self) -> str:
        lines = [self.explanation, ""]
        lines.append(f"{'candidate':22s} {'score':>10s} {'p':>9s} {'BIC gain':>10s} {'removes':>8s}  detection limit")
        for c in self.candidates:
            gain = f"{c.bic_gain:10.1f}" if c.refitted else " " * 10
            removes = f"{100 * c.error_reduction:7.0f}%" if c.refitted else " " * 8
            limit = f"{c.detection_limit:.2g} {c.unit}" if c.testable else "not testable"
            lines.append(f"{c.id:22s} {c.score:10.1f} {c.p_value:9.2g} {gain} {removes}  {limit}")
        lines.append("score: chi-square of predictions one sample ahead, less the price of the parameters")
        lines.append("")
        for title, tests in (("base model", self.tests), ("with what was added", self.left if self.additions else ())):
            for test in tests:
                said = "rejects" if test.rejects else "passes"
                lines.append(f"{title}: {test.test} {said} (p = {test.p_value:.2g}): {test.words}")
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw a bar chart of the candidates and the missing-force curve, as a matplotlib figure."""
        return draw(self)


def diagnose(
    fit: Fit,
    recording: Recording,
    *,
    candidates: Sequence[type[Effect]] | None = None,
    thorough: bool = True,
    policy: DiagnosisPolicy = STANDARD,
    progress: bool = True,
) -> Diagnosis:
    """Say which effects the model of a fit leaves out, or that none is, or that the data cannot say.

    Args:
        fit: of the base model to this recording.
        recording: that the model was fitted to.
        candidates: classes of effects to try; by default the whole catalogue, and that a constant is wrong which the model takes
            as exact beside others. Those of the model are passed over.
        thorough: where the verdict would be unknown, look again at what raised no alarm; that may take minutes.
        policy: the thresholds; see `DiagnosisPolicy`.
        progress: show a bar.

    Raises:
        ValueError: nothing moves in the recording, no candidate is left, or one is declared so that it cannot be looked for.
        RuntimeError: JAX was not configured for double precision.

    Source: the steps of Kristensen, Madsen and Jorgensen (2004) for the predictor; score tests as in Basseville and
    Nikiforov, Detection of Abrupt Changes (1993), section 7.
    """
    require_configured()
    make_room()
    began = time.perf_counter()
    classes = offered(fit.model, candidates)
    if not classes:
        raise ValueError("no candidate is left: the model has every effect that was offered.")
    with tqdm(total=None, disable=not progress, desc="diagnose", unit=" steps", leave=False) as bar:
        search = dataclasses.replace(Search.of(fit, recording, classes, bar), policy=policy)
        # Where some are in the model already, as in the loop, its other tests are still worth asking.
        if not search.absent and not any(c.id in fit.model for c in candidates or ()):
            raise ValueError(
                f"no candidate is left: nothing in the recording could show {', '.join(c.id for c in classes)}."
            )
        with warnings.catch_warnings():  # what threads do to the filters at the same time ends here
            found = _searched(search, thorough)
        bar.set_description("diagnose: verdict")
        told = _told(found, [c for c in classes if c.id not in search.absent], fit)
    if (
        told.simulation is not None
        and told.simulation.cause == "unexplained"
        and max(told.random_force, told.random_torque) < SHAKEN  # or else they are the reason
    ):
        told = dataclasses.replace(told, explanation=told.explanation + strayed(fit.residual_std, fit.noise, recording))
    return dataclasses.replace(told, seconds=time.perf_counter() - began)


@dataclasses.dataclass(frozen=True)
class _Found:
    """The outcome of a search."""

    search: Search
    base: Refit
    tested: Tested
    steps: list[Step]
    refits: Tried
    thorough: bool


def _searched(search: Search, thorough: bool) -> _Found:
    search.bar.set_description("diagnose: predictor of the base model")
    with ThreadPoolExecutor(1) as other:
        other.submit(search.compile_base)
        ahead = Ahead(other, search.pieces_of_tests())
        search, base = search.recoloured(search.base())
        search, base = search.trusting(base)
        search.bar.set_description("diagnose: candidates")
        tested = search.tested(base, ahead)
    steps, refits = improvements(search, base, tested)
    if any(test.rejects for test in tested.tests) and not any(e.kind == "rest" for e in search.recording.experiments):
        # Noise that wanders makes almost every effect look useful; without rest records the likelihood must say.
        search.bar.set_description("diagnose: colour of the noise")
        other = search.coloured(base)
        if other is not None:
            other, coloured = other.recoloured(other.base())
            final = steps[-1].refit if steps else base
            if coloured.predictor.log_likelihood > final.predictor.log_likelihood:
                search, base, tested = other, coloured, other.tested(coloured)
                steps, refits = improvements(search, base, tested)
    if thorough:
        steps, refits = second_looks(search, base, tested, steps, refits)
    return _Found(search, base, tested, steps, refits, thorough)


def _told(found: _Found, unshown: Sequence[type[Effect]], fit: Fit) -> Diagnosis:
    """Return the verdict and its reasons, also of candidates that nothing in the recording could show."""
    search, base, tests = found.search, found.base, found.tested.tests
    verdict, count, removed = judge(found.steps, tests, search.samples, search.policy)
    simulation = search.simulation(fit, base, found.tested.screened) if verdict == "adequate" else None
    latent = search.latent(base) if verdict == "unknown" else ()
    if count:
        simulation = search.stand_in(fit, found.steps[count - 1].refit)
    if simulation is not None and simulation.vetoes:
        verdict, count = "unknown", 0
    candidates = _candidates(search, base, found.tested, found.steps, count, found.refits)
    candidates += [_not_testable(c, float(np.log(search.samples))) for c in unshown]
    steps = without_named_rivals(found.steps[:count])
    final, left = (steps[-1].refit, steps[-1].left) if steps else (base, tests)
    groups = [(step.id, *step.rivals) for step in steps]
    by_id = {c.id: c for c in candidates}
    told = Diagnosis(
        verdict=verdict,
        effects=tuple(
            dataclasses.replace(by_id[i], confusable_with=tuple(other for other in group if other != i))
            for group in groups
            for i in group
        ),
        additions=tuple(search.effect(step.id, final) for step in steps),
        candidates=tuple(candidates),
        tests=tests,
        left=left,
        removed=removed,
        curves=found.tested.curves,
        latent=latent,
        places=search.places(base),
        lines=search.lines(base),
        random_force=base.predictor.random_force,
        random_torque=base.predictor.random_torque,
        explanation="",
        seconds=0.0,
        simulation=simulation,
        policy=search.policy,
    )
    return dataclasses.replace(told, explanation=_explanation(told, steps, found, found.steps[count:]))


def _explanation(told: Diagnosis, steps: Sequence[Step], found: _Found, further: Sequence[Step]) -> str:
    """Return the verdict in plain words, with what it rests on and what would make it surer."""
    search = found.search
    text = words(
        told.verdict, told.effects, told.candidates, steps, told.tests, told.left, told.removed, told.curves, told.latent,
        told.places, told.lines, told.simulation, told.policy,
    )  # fmt: skip
    if told.simulation is not None and further and not steps:
        text += without_the_physics(further)
    if steps and further:
        text += not_named(further, told.left, search.samples)
    if steps and steps[0].id not in {s.id for s in alarming(found.tested.screened)}:
        text += f" {steps[0].id} raised no alarm by itself: it was tried because what did explains less, or nothing."
    if struck := [effect.id for effect in told.additions if effect.acts_by_contact]:
        text += (
            f" The intervals of {', '.join(struck)} may be far too narrow: they leave out when parts hit each other."
        )
    if told.verdict == "unknown" and told.simulation is None and not found.thorough:
        text += " This was a quick diagnosis: a thorough one also tries what raised no alarm."
    vetoed = told.simulation is not None and told.simulation.vetoes
    if not vetoed and not any(
        test.rejects for test in told.left
    ):  # or else random forces may stand for what is still missing
        final = (steps[-1].refit if steps else found.base).predictor
        text += shaken(final.random_force, final.random_torque, search.left_out)
    if search.assumed:
        text += f" Coloured noise of {', '.join(search.assumed)} was assumed: the data are far more likely with it."
    text += doubt([c.id for c in told.effects], search.model)
    return text + surer(told.verdict, search.recording)


def compile_diagnosis(model: RTAC, recording: Recording, candidates: Sequence[type[Effect]] | None) -> None:
    """Compile what `diagnose` will run first; for a thread beside the one that fits the model."""
    Search.compile_for(model, recording, offered(model, candidates))


def _not_testable(c: type[Effect], price: float) -> Candidate:
    """Return a candidate that gains nothing, whatever its size."""
    names = c.amplitudes()
    return Candidate(
        id=c.id, score=-len(names) * price, chi_square=0.0, p_value=1.0, detection_limit=float("inf"),
        unit=declarations(c)[names[0]].unit, testable=False,
    )  # fmt: skip


def _candidates(
    search: Search,
    base: Refit,
    tested: Tested,
    steps: Sequence[Step],
    named: int,
    refits: Tried,
) -> list[Candidate]:
    """Return all candidates, those that improved the model first; the first `named` steps stand in the verdict."""
    price = float(np.log(search.samples))
    best = {s.id: s for s in by_size(tested.screened, price)}
    alike = correlations(best)
    limits = search.limits(base, best)
    most = _most(base, steps, refits, tested.tests, search.samples)
    within = {step.id for step in steps[:named]}
    found = []
    for s in best.values():
        first, limit = main_amplitude(s), limits[s.id]
        plausible = abs(float(np.asarray(getattr(s.instance, first))))
        c = Candidate(
            id=s.id,
            score=s.statistic - len(s.amplitudes) * price,
            chi_square=s.statistic,
            p_value=p_by_chance(s, len(tested.screened)),
            detection_limit=limit,
            unit=declarations(s.instance)[first].unit,
            testable=bool(np.isfinite(limit) and limit < TESTABLE * plausible),
            correlation=alike[s.id],
        )
        if s.id in refits:
            before, refit = refits[s.id]
            last = steps[named - 1].refit if s.id in within else refit
            removed = np.exp(-2 * gain(base, before) / search.samples) - np.exp(-2 * gain(base, refit) / search.samples)
            c = dataclasses.replace(
                c,
                refitted=True,
                bic_gain=bic_gain(search, before, refit),
                held_out_gain=search.held_out_gain(before, refit),
                error_reduction=float(np.clip(removed / most, 0.0, 1.0)) if most > 0 else 0.0,
                parameters=search.parameters(s.id, last),
            )
        found.append(c)
    order = {step.id: place for place, step in enumerate(steps)}
    found.sort(key=lambda c: (order.get(c.id, len(order)), -c.bic_gain if c.refitted else 0.0, -c.score))
    return found


def _most(
    base: Refit,
    steps: Sequence[Step],
    refits: Tried,
    tests: Sequence[Evidence],
    samples: int,
) -> float:
    """Return the fraction of the base model's squared prediction error that is known to be avoidable."""
    single = [gain(base, refit) for before, refit in refits.values() if before is base]
    least = [np.exp(-2 * max(single, default=0.0) / samples), 1 - min(excess_of(tests) / samples, 1.0)]
    if steps:
        least.append(floor(steps, samples))
    return float(1 - min(least))
