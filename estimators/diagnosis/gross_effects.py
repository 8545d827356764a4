"""Gross effects: where the fit of the base model follows nothing, candidates are screened by the equations of motion."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from estimators.closed_form.fit import starting_values
from estimators.closed_form.motion_regression import motion_regression
from estimators.core.data import Data, moving, pieces
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
from rtac_jax.measurement import Recording

_INERTIAS = 4.0 ** np.arange(8)  # of the least that a rigid body can have, which are tried where nobody knows the arm's
_FINER = 4.0 ** np.array([-0.6, -0.3, 0.3, 0.6])


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
