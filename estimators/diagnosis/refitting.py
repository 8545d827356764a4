"""Refitting: the predictor of a model, with candidates added or taken away."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial, reduce

import jax
import numpy as np

from estimators.core.deadline import OutOfTimeError, require_time
from estimators.core.fisher_information import information
from estimators.core.fit import Fit, Parameter
from estimators.core.jacobian_factor import Arguments, factor
from estimators.core.parameter_space import Space
from estimators.core.residual import start_rows
from estimators.core.results import NotIdentifiableError
from estimators.diagnosis.contact_trials import (
    acting_on_arm,
    begins_of,
    climbed_by_trial,
    few_random_forces,
    in_turn,
    likeliest_begin,
    trial_data,
)
from estimators.diagnosis.evidence import HeldOut, SimulationError
from estimators.diagnosis.gross_effects import placed_inside
from estimators.diagnosis.innovation_tests import pieces_of_tests, run_tests, simulation_error
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.setting import Setting, begun, effect_of, model_with, space_for
from estimators.diagnosis.shared_structure import of_structure, run_as
from estimators.diagnosis.workers import Workers
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.equation_screening import Explained
from estimators.output_error.fit import output_error
from estimators.prediction_error.noise_estimation import fit_predictor, low_process_noise
from estimators.validation.model_comparison import by_sample, held_out
from rtac_jax import RTAC
from rtac_jax.parameters import declarations


def refit_with(setting: Setting, before: Refit, s: Screened) -> Refit:
    """Fit a model with one candidate more, all parameters together."""
    model, free, added = beginning(setting, before, s)
    return fitted(setting, added, model, free, before.predictor.noise, before.start)


def refit_from_equations(setting: Setting, before: Refit, e: Explained) -> Refit:
    """Refit with a candidate from where the equations of motion put it and the base model's parameters, with little random force.

    Where the base model follows nothing, its own parameters and random forces are those of another motion.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free.
    """
    model, free, added = _extended(setting, before, e)
    shape = {name: float(np.asarray(getattr(e.instance, name))) for name in declarations(e.instance)}
    sizes = shape | dict(zip(e.amplitudes, np.asarray(e.begin).tolist(), strict=True))
    values = {**e.values} | {f"{e.id}.{name}": value for name, value in sizes.items()}
    noise = low_process_noise(before.predictor.noise)
    return fitted(setting, added, placed_inside(model, values), free, noise, {})


def refit_thoroughly(setting: Setting, before: Refit, s: Screened) -> Refit:
    """Return the likelier of `refit_with` and, for a contact, `refit_by_trial`, or, for any other effect, `refit_by_simulation`.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free, in both.
    """
    filtered = other = None
    with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError):
        filtered = refit_with(setting, before, s)
    contact = setting.classes[s.id].acts_by_contact
    with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError):
        other = refit_by_trial(setting, before, s) if contact else refit_by_simulation(setting, before, s, filtered)
    refits = [refit for refit in (filtered, other) if refit is not None]
    if not refits:
        raise FloatingPointError(f"with {s.id} the model diverges, wherever its refit begins.")
    return max(refits, key=lambda one: one.predictor.log_likelihood)


def refit_by_simulation(setting: Setting, before: Refit, s: Screened, filtered: Refit | None) -> Refit:
    """Refit from where a free simulation ends.

    What swings fast misleads the start that the first samples show. The filter takes it for a large random torque, and the
    fit to its innovations ends there. So the refit begins again from parameters and starts with which a simulation follows
    the data, and from little random force. Simulations are fitted from the fit that is diagnosed, and from what the filter
    found: of what rings for long a simulation follows only what it has the frequency of, which the filter finds from
    farther away.

    Args:
        setting: of the diagnosis.
        before: the model without the candidate.
        s: the candidate.
        filtered: the refit by the filter, if there is one.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free, from every simulation.
    """
    model, free, added = beginning(setting, before, s)
    begins = [reduce(RTAC.__add__, [effect for effect in model.effects if effect.id in added], setting.model)]
    if filtered is not None:
        known = {name: value for name, value in filtered.values.items() if name in begins[0].parameters}
        begins.append(begins[0].with_values(known))
    simulated: list[Fit] = []
    for begin in begins:
        with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, NotIdentifiableError):
            simulated.append(output_error(begin, setting.recording, from_model=True, progress=False))
    for found in sorted(simulated, key=lambda found: found.statistics["cost"]):
        with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError):
            return from_simulation(setting, before, added, model, free, found)
    raise FloatingPointError(f"with {s.id} the model diverges in a simulation.")


def refit_by_trial(setting: Setting, before: Refit, s: Screened) -> Refit:
    """Refit what works by contact: trials of what moves it, a fit of all else, and a fit of all, in turn.

    Trials are of the beginning of every experiment, which tells where a contact is; fits are of all samples.
    When a contact begins and ends moves by whole samples as a parameter changes, so the likelihood has steps, and the
    derivative of the innovations says nothing of them: a fit alone ends a few percent from the truth, with random forces
    for what it does not follow. So trials begin with little of these, at the likeliest of many sizes and shapes.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free.
    """
    model, free, added = _extended(setting, before, s)
    model = model.with_values({n: v for n, v in before.values.items() if n in model.parameters})
    moving = acting_on_arm(model, free)
    part = trial_data(setting.data)
    others = tuple(name for name in free if name not in moving)

    def placed(values: Mapping[str, float], each: jax.Array) -> Space:
        there = model.with_values(values)
        return dataclasses.replace(begun(space_for(setting, there, moving), there, before.start), each_values=each)

    def climbed(space: Space, noise: np.ndarray, side: float) -> tuple[Space, np.ndarray]:
        return climbed_by_trial(model, part, space, setting.prior.starting(space), noise, setting.substeps, side=side)

    def climbed_and_fitted(space: Space, noise: np.ndarray) -> tuple[Refit, Space]:
        values = dict(zip(space.names, np.asarray(space.values).tolist(), strict=True))
        one = fitted(setting, added, model.with_values(values), others, noise, before.start)
        refit = fitted(setting, added, model.with_values(one.values), free, one.predictor.noise, before.start)
        return refit, placed(refit.values, refit.predictor.physical[1])

    begins = begins_of(s.instance, s.amplitudes)
    several = [placed({f"{s.id}.{n}": v for n, v in one.items()}, before.predictor.physical[1]) for one in begins]
    few = few_random_forces(before.predictor.noise)
    space = likeliest_begin(model, part, several, setting.prior.starting(several[0]), few, setting.substeps)
    return in_turn(space, before, climbed, climbed_and_fitted)


def from_simulation(
    setting: Setting, before: Refit, added: tuple[str, ...], model: RTAC, free: tuple[str, ...], found: Fit
) -> Refit:
    """Fit a model by its predictions from where a fitted simulation ended, with little random force.

    Args:
        setting: of the diagnosis.
        before: the model without the last of the effects.
        added: ids of the effects beyond the base model.
        model: with them.
        free: names of its free parameters.
        found: the fit by simulation.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free.
    """
    values = {name: parameter.value for name, parameter in found.parameters.items()}
    noise = low_process_noise(before.predictor.noise)
    start = np.stack([found.start[e.name] for e in setting.experiments], axis=1)
    starts = dict(zip(start_rows(found.model), start, strict=True))
    return fitted(setting, added, model.with_values(values), free, noise, starts)


def extended_simulation(setting: Setting, fit: Fit, final: Refit) -> SimulationError:
    """Return the error of a simulation with the effects that were added, fitted from where the predictor is.

    Where none can be fitted, the one without the effects says what is known.

    Args:
        setting: of the diagnosis.
        fit: that is diagnosed.
        final: the predictor of the model with the effects.
    """
    setting.progress.at("diagnose: simulation with what was added")
    extended = reduce(RTAC.__add__, [effect_of(setting, i, final) for i in final.added], fit.model)
    extended = extended.with_values({n: v for n, v in final.values.items() if n in extended.parameters})
    base = [name for name in extended.free if name.split(".")[0] not in final.added]
    # What the data leave free, as the torque constant of an arm that its drive never turns, is held where the predictor has it.
    for model in (extended, extended.fix(*base)):
        with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, NotIdentifiableError):
            simulated = output_error(model, setting.recording, from_model=True, progress=False)
            return simulation_error(setting, simulated, final)
    return simulation_error(setting, fit, final)


def _refit_or_none(setting: Setting, before: Refit, s: Screened | Explained, way: Way) -> Refit | None:
    """Fit a model with one candidate more; None if the model diverges with it, or the time is over."""
    setting.progress.at(f"diagnose: refit with {s.id}")
    with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, NotIdentifiableError, OutOfTimeError):
        require_time()
        if isinstance(s, Explained):
            return refit_from_equations(setting, before, s)
        return (refit_thoroughly if way == "thorough" else refit_with)(setting, before, s)
    return None


def refit_each(
    setting: Setting, before: Refit, several: Sequence[Screened | Explained], way: Way, workers: Workers
) -> dict[str, Refit]:
    """Refit with each of several candidates, but for those with which the model diverges."""
    return _refits(several, workers.each(lambda s: _refit_or_none(setting, before, s, way), several))


def refit_first(
    setting: Setting,
    before: Refit,
    first: Screened | Explained,
    near: Sequence[Screened | Explained],
    way: Way,
    workers: Workers,
) -> tuple[dict[str, Refit], Tested | None]:
    """Refit with the first candidate and those near it, and test the first.

    Its tests are compiled while it is fitted, the others fitted while it is tested.
    """
    _, free, added = _extended(setting, before, first)
    refit, tested, found = workers.first_beside(
        pieces_of_tests(setting, added, free),
        partial(_refit_or_none, setting, before, first, way),
        lambda one, code: run_tests(setting, one, code),
        [partial(_refit_or_none, setting, before, s, way) for s in near],
    )
    return _refits([first, *near], [refit, *found]), tested


def held_out_gains(before: Refit, after: Refit) -> HeldOut:
    """Return what the effects of a model gain in each experiment if they are estimated from the others only."""
    added = [place for place, name in enumerate(after.free) if name not in before.free]
    change, known = held_out(after.triangles, len(after.predictor.unknowns.shared), added)
    gains = np.asarray(after.predictor.filtered.log_likelihood) - np.asarray(before.predictor.filtered.log_likelihood)
    return HeldOut(tuple((gains + change).tolist()), tuple(known.tolist()))


def parameters_of(effect: str, refit: Refit) -> dict[str, Parameter]:
    """Return the parameters of an added effect with standard deviations."""
    known = information(refit.triangles, refit.space, refit.predictor.unknowns)
    deviations = dict(zip(known.names, np.sqrt(np.diagonal(known.covariance)), strict=True))
    return {
        name.split(".")[1]: Parameter(float(value), float(deviations.get(name, 0.0)), refit.model.parameters[name].unit)
        for name, value in refit.values.items()
        if name.split(".")[0] == effect
    }


def looseness_of(refit: Refit) -> dict[str, float]:
    """Return how loosely the data hold each added effect: the largest relative deviation that it takes part in."""
    known = information(refit.triangles, refit.space, refit.predictor.unknowns)
    return {effect: known.looseness(f"{effect}.") for effect in refit.added}


def beginning(
    setting: Setting, before: Refit, s: Screened | Explained
) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
    """Return a model with one candidate more where its refit begins.

    Returned beside it are its free parameters, and the ids of what was added to the base model.
    """
    declared = declarations(s.instance)
    values = before.values
    for name in declared:
        start = float(np.asarray(getattr(s.instance, name)))
        if name in s.amplitudes:
            begin = float(s.begin[s.amplitudes.index(name)])
            plausible = abs(start)
            start = float(np.sign(begin) * np.clip(abs(begin), 0.05 * plausible, 20 * plausible))
            start = start or 0.05 * plausible
        values[f"{s.id}.{name}"] = start
    model, free, added = _extended(setting, before, s)
    return model.with_values({n: v for n, v in values.items() if n in model.parameters}), free, added


def _extended(
    setting: Setting, before: Refit, s: Screened | Explained
) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
    """Return a model with one candidate more at null, its free parameters, and the ids of what was added."""
    added = (*before.added, s.id)
    declared = declarations(s.instance)
    model = model_with(setting, [effect for i, effect in setting.absent.items() if i in added])
    free = before.free + tuple(f"{s.id}.{n}" for n in declared if not declared[n].fixed)
    return model, free, added


def fitted(
    setting: Setting,
    added: tuple[str, ...],
    model: RTAC,
    free: tuple[str, ...],
    noise: np.ndarray | None,
    start: Mapping[str, np.ndarray],
) -> Refit:
    """Fit a model by its predictions one sample ahead.

    Args:
        setting: of the diagnosis.
        added: ids of the effects beyond the base model.
        model: with them, at the values where the fit begins.
        free: names of its free parameters.
        noise: where its exponents begin; None for the prior.
        start: states at the start by name, where they are known.

    Raises:
        ArithmeticError: the model diverges, or leaves parameters free.
    """
    run, wider, space = run_as(setting, added, model, free, start)
    prior = setting.prior.starting(space)
    found = fit_predictor(
        run, setting.data, wider, prior, substeps=setting.substeps, first=noise, progress=setting.progress.step
    )
    arguments = Arguments(run, setting.data, wider, found.filtered.whitener, found.filtered.gain, setting.substeps)
    found, triangles = of_structure(found, np.asarray(factor(found.unknowns, arguments)), wider, space)
    return Refit(added, model, found, space, by_sample(found.filtered), free, triangles)


def _refits(several: Sequence[Screened | Explained], found: Sequence[Refit | None]) -> dict[str, Refit]:
    return {s.id: refit for s, refit in zip(several, found, strict=True) if refit is not None}
