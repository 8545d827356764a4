"""Gross effects: where the fit of the base model follows nothing, candidates are screened by the equations of motion."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimators.closed_form.fit import starting_values
from estimators.closed_form.motion_regression import motion_regression
from estimators.core.data import Data, motion_of, moving, origins, pieces
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.setting import Setting, absent_like
from estimators.diagnosis.testability import can_show
from estimators.inference.shaken_simulation import unfollowed
from estimators.inference.simulation_residual import follows_nothing
from estimators.misspecification.equation_screening import Explained, explained_by
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.effects.one_sided_spring import GROSS
from rtac_jax.measurement import Experiment, Recording

_ENOUGH = 16_000  # samples of all experiments together that a gross effect is looked for in
_LEAST = 1_000  # of each of many experiments
_INERTIAS = 4.0 ** np.arange(8)  # of the least that a rigid body can have, which are tried where nobody knows the arm's
_FINER = 4.0 ** np.array([-0.6, -0.3, 0.3, 0.6])
_LIVELY = 0.5  # rms of a beginning over that of the whole, from which on it shows as much


def is_gross(setting: Setting, fit: Fit, base: Refit) -> bool:
    """Return whether the fit of the base model follows nothing.

    Args:
        setting: the data and the policy.
        fit: that is diagnosed.
        base: predictor of its model.
    """
    random = (float(base.predictor.random_force), float(base.predictor.random_torque))
    limits = setting.policy.simulation
    return follows_nothing(unfollowed(fit, setting.data, limits), random, float(setting.samples_per_radian), limits)


def enough_of(fit: Fit, recording: Recording, policy: DiagnosisPolicy) -> Recording:
    """Return a part of every experiment where the fit follows nothing and they show as much motion, or else the recording.

    What dominates the motion shows in a part of many samples as well, and every refit takes as long as there are samples. What is
    small beside it is for the diagnosis of the model with it, which sees them all.

    Args:
        fit: that is diagnosed.
        recording: that it was fitted to.
        policy: the thresholds.
    """
    whole = moving(recording)
    several = pieces(whole)
    data = Data.of(several)
    if sum(e.samples for e in several) < 2 * _ENOUGH or unfollowed(fit, data, policy.simulation) <= policy.unfollowed:
        return recording
    samples = max(_ENOUGH // len(whole), _LEAST)
    origin = origins(whole)
    found = [_part([e for e in several if origin[e.name] == one.name], samples) for one in whole]
    part = [e for beginnings in found for e in beginnings]
    if np.any(motion_of(Data.of(part)) < _LIVELY * motion_of(data)):
        return recording
    rest = [e for e in recording.experiments if e.kind == "rest"]
    return dataclasses.replace(recording, experiments=(*part, *rest))


def _part(several: Sequence[Experiment], samples: int) -> list[Experiment]:
    """Return the beginning of an experiment, or those of its pieces, from first to last, that have about as many samples."""
    if len(several) > 1:
        count = min(max(samples // several[0].samples, 1), len(several))
        return [several[place] for place in np.linspace(0, len(several) - 1, count).astype(int)]
    return [several[0].cut(0, min(samples, several[0].samples), several[0].name)]


def offering_gross(setting: Setting) -> Setting:
    """Return the setting with candidates beside the catalogue that are never small."""
    scales = scales_of(setting.model, setting.experiments)
    more = {
        i: found
        for i, c in GROSS.items()
        if i not in setting.model and can_show(c, setting.experiments) and (found := c.candidates(scales))
    }
    return dataclasses.replace(
        setting,
        absent=setting.absent | {i: absent_like(found[len(found) // 2]) for i, found in more.items()},
        classes=setting.classes | {i: GROSS[i] for i in more},
        instances=[*setting.instances, *(one for found in more.values() for one in found)],
    )


def screened_by_equations(setting: Setting, model: RTAC, added: Collection[str] = ()) -> list[Explained]:
    """Return what candidates take off the equation error of a model, those that a forward selection takes first.

    Args:
        setting: the data and the candidates.
        model: at its estimates.
        added: ids of the candidates that it has.
    """
    instances = [i for i in setting.instances if i.id not in added]
    if "arm_inertia" not in model.free:
        return _explained(setting, model, instances)[1]
    first = motion_regression(model, setting.experiments, noise_levels(setting.recording.experiments))
    moment = 0.0 if first is None else first.solved().values.get("eccentric_moment", 0.0)
    if not moment > 0:
        return _explained(setting, model, instances)[1]
    # It fixes the scale of the arm's equation, and a fit that follows nothing may have run away with it. No rigid body has less
    # than the moment squared over the mass.
    least = moment**2 / float(np.asarray(model["total_mass"]))
    found = [(by, *_explained(setting, model.with_values({"arm_inertia": least * by}), instances)) for by in _INERTIAS]
    best = min(found, key=lambda one: one[1])
    for by in best[0] * _FINER:
        found.append((by, *_explained(setting, model.with_values({"arm_inertia": least * by}), instances)))
    return min(found, key=lambda one: one[1])[2]


def _explained(setting: Setting, model: RTAC, instances: Sequence[Effect]) -> tuple[float, list[Explained]]:
    """Return what is left of the equations of a model beside what a forward selection takes, and what candidates explain."""
    inertia, policy = float(np.asarray(model["arm_inertia"])), setting.policy
    equations = motion_regression(model, setting.experiments, noise_levels(setting.recording.experiments))
    if equations is None:
        return np.inf, []
    explained = explained_by(equations, instances, least=policy.bic_gain, most=policy.effects)
    left = equations.misfit(equations.solved(), inertia) - sum(one.statistic for one in explained if one.selected)
    with_scale = [dataclasses.replace(one, values={**one.values, "arm_inertia": inertia}) for one in explained]
    return left, with_scale if "arm_inertia" in model.free else explained


def begun_by_equations(fit: Fit, model: RTAC, recording: Recording, policy: DiagnosisPolicy) -> RTAC:
    """Return a model with effects where the equations of motion put its other parameters, if the fit without them is lost.

    It is lost where it follows nothing, or where it ended the data leave parameters free.

    Args:
        fit: of the model without the effects.
        model: with them, at their estimates; everything else as the fit left it.
        recording: that was fitted.
        policy: the thresholds.
    """
    experiments = pieces(moving(recording))
    if fit.lost:  # its scale is lost, too, which the regression takes from the model
        return starting_values(model, recording)
    if unfollowed(fit, Data.of(experiments), policy.simulation) <= policy.unfollowed:
        return model
    equations = motion_regression(model, experiments, noise_levels(recording.experiments))
    return model if equations is None else placed_inside(model, equations.solved().values)


def placed_inside(model: RTAC, values: Mapping[str, float]) -> RTAC:
    """Return a model with these of its values, those of free parameters beyond a bound a hundredth of the model's own inside it.

    An eccentric moment that no rigid body has is left as it was.
    """
    declared, free = model.parameters, set(model.free)
    scale = np.prod([values.get(n, float(np.mean(np.asarray(model[n])))) for n in ("total_mass", "arm_inertia")])
    inside = {}
    for name in [name for name in values if name in declared]:
        if name == "eccentric_moment" and not values[name] ** 2 < scale:
            continue
        low, high = declared[name].bounds
        room = 0.01 * abs(float(np.mean(np.asarray(model[name])))) if name in free else 0.0
        inside[name] = float(np.clip(values[name], low + room, high - room))
    return model.with_values(inside)
