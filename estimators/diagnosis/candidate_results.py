"""The results of every candidate: its score, its detection limit, and what a refit with it gained."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.choice import bic_gain, gain, held_out_gain
from estimators.diagnosis.live_laboratory import LiveLaboratory
from estimators.diagnosis.refitting import parameters_of
from estimators.diagnosis.removed_error import floor
from estimators.diagnosis.selection import Selection, by_size
from estimators.diagnosis.simulation_selection import excess_left
from estimators.diagnosis.verdict import Judgement
from estimators.misspecification.adequacy import excess_of, p_by_chance
from estimators.misspecification.detection_limit import is_testable, main_amplitude
from rtac_jax.effects import Effect
from rtac_jax.parameters import declarations


def not_testable(c: type[Effect], price: float) -> Candidate:
    """Return a candidate that gains nothing, whatever its size."""
    names = c.amplitudes()
    return Candidate(
        id=c.id, score=-len(names) * price, chi_square=0.0, p_value=1.0, detection_limit=float("inf"),
        unit=declarations(c)[names[0]].unit, testable=False,
    )  # fmt: skip


def candidates_of(laboratory: LiveLaboratory, found: Judgement) -> list[Candidate]:
    """Return all candidates, those that improved the model first."""
    selection, samples, policy = found.selection, laboratory.facts.samples, laboratory.policy
    screened = laboratory.models.tested(selection.base).screened
    price = float(np.log(samples))
    best = {s.id: s for s in by_size(screened, price)}
    detectable = laboratory.models.detectability(selection.base)
    most = _most(selection, samples)
    within = set(found.effects)
    shown = within.union(*found.rivals.values())
    several: list[Candidate] = []
    for s in best.values():
        first, limit = main_amplitude(s), detectable.limits[s.id]
        c = Candidate(
            id=s.id,
            score=s.statistic - len(s.amplitudes) * price,
            chi_square=s.statistic,
            p_value=p_by_chance(s, len(screened)),
            detection_limit=limit,
            unit=declarations(s.instance)[first].unit,
            # What acts by contact, or random forces stand for, shows once the filter follows it.
            testable=is_testable(s, limit, policy.testable) or s.id in shown,
            correlation=detectable.correlations[s.id],
        )
        if s.id in selection.tried:
            before, model = selection.tried[s.id]
            _, last = laboratory.models.computed(found.final if s.id in within else model)
            start = selection.base
            removed = np.exp(-2 * gain(start, before) / samples) - np.exp(-2 * gain(start, model) / samples)
            c = dataclasses.replace(
                c,
                refitted=True,
                bic_gain=bic_gain(samples, before, model),
                held_out_gain=held_out_gain(laboratory, before, model, policy),
                error_reduction=float(np.clip(removed / most, 0.0, 1.0)) if most > 0 else 0.0,
                parameters=parameters_of(s.id, last),
            )
        several.append(c)
    order = {step.id: place for place, step in enumerate(selection.steps)}
    several.sort(key=lambda c: (order.get(c.id, len(order)), -c.bic_gain if c.refitted else 0.0, -c.score))
    return several


def nearest_simulated(
    laboratory: LiveLaboratory, found: Judgement, candidates: Mapping[str, Candidate]
) -> tuple[Candidate, ...]:
    """Return the candidates with which a simulation that fails leaves least, the nearest first; none where one is named."""
    if found.steps or found.simulation is None or found.simulation.cause != "unexplained":
        return ()
    before, policy = found.selection.base, laboratory.policy
    base, fits = laboratory.simulation(before).error, laboratory.simulated.with_one(before.number)
    left = {i: excess_left(fit.residual_over_noise, base, policy) for i, fit in fits.items()}
    near = sorted((i for i in left if left[i] <= 1 - policy.static), key=lambda i: left[i])
    return tuple(
        dataclasses.replace(
            candidates[i],
            error_reduction=1 - left[i],
            parameters={n.split(".")[1]: p for n, p in fits[i].parameters.items() if n.split(".")[0] == i},
        )
        for i in near
    )


def _most(selection: Selection, samples: int) -> float:
    """Return the fraction of the base model's squared prediction error that is known to be avoidable; 0 where nothing rejects."""
    if not selection.steps and not any(test.rejects for test in selection.tests):
        return 0.0
    base = selection.base
    single = [gain(base, model) for before, model in selection.tried.values() if before.number == base.number]
    least = [
        np.exp(-2 * max(single, default=0.0) / samples),
        1 - min(excess_of(selection.tests) / samples, 1.0),
    ]
    if selection.steps:
        least.append(floor(selection.steps, samples))
    return float(1 - min(least))
