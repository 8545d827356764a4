"""The structure that refits share: with every simple candidate absent beside what was added, so that one program runs them all."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.fit import Fit
from estimators.core.parameter_space import Physical, Space
from estimators.diagnosis.setting import Setting, begun, by_name, model_with, padded_space, space_for
from estimators.prediction_error.noise_estimation import Predictor
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE, Actuator, Effect, Force, Sensor

# Samples times experiments, as they are padded, up to which it serves: a pass takes 1.4 times as long with twenty effects more, and
# two programs of an effect's own, which a refit saves, 2.3 s of a processor (two cores, 2026-11-30), 250 passes of this size.
_MOST = 8 * 4096
# `Physical` of the model that is run, which has more parameters.
_Physical = tuple[Float[Array, " run"], Float[Array, "each experiment"], Float[Array, "start experiment"]]
_ROOM = 4  # unknowns are padded to a multiple of this: most simple effects have one or two


def is_simple(effect: Effect) -> bool:
    """Return whether an effect of the catalogue has no states and no threshold at which a step of the integration is cut.

    What a user's own effect does where it is absent nobody knows before it was screened.
    """
    known = CATALOGUE.get(effect.id) is type(effect)
    return known and not effect.states and isinstance(effect, Force | Actuator | Sensor)


def is_short(setting: Setting) -> bool:
    """Return whether there are so few samples that code costs more than passes."""
    return setting.data.room * setting.data.experiments <= _MOST


def _simple(setting: Setting) -> dict[str, Effect]:
    """Return the absent candidates that may share a structure, by id; none of many samples."""
    return {i: effect for i, effect in setting.absent.items() if is_short(setting) and is_simple(effect)}


def run_model(setting: Setting, added: Sequence[str]) -> RTAC | None:
    """Return a model with what was added and every other simple candidate absent; None where an own structure is as quick.

    That is the base model's, which its fit has compiled unless that was of more samples, one with an effect that is not simple,
    and of many samples.
    """
    return _with_simple(setting, added) if added or setting.part else None


def probed_model(setting: Setting, added: Sequence[str]) -> RTAC | None:
    """Return that model for the derivatives of innovations, which no fit compiles; None also of a base model with more states.

    That was a refit of a diagnosis before, which has compiled it.
    """
    return None if any(effect.states for effect in setting.model.effects) else _with_simple(setting, added)


def _with_simple(setting: Setting, added: Sequence[str]) -> RTAC | None:
    simple = _simple(setting)
    return model_with(setting, list(simple.values())) if simple and set(added) <= set(simple) else None


def passed_as(
    setting: Setting, added: Sequence[str], model: RTAC, space: Space, physical: Physical
) -> tuple[RTAC, Space, _Physical]:
    """Return what a pass of the filter is run by for a model with what was added, at given values.

    Args:
        setting: of the diagnosis.
        added: ids of the effects beyond the base model.
        model: with them.
        space: of its parameters.
        physical: their values, those of each experiment, and the states at the start.
    """
    if (run := run_model(setting, added)) is None:
        return model, space, physical
    shared, each, start = physical
    wide = space_for(setting, run, ())
    return run, wide, (by_name(wide, space, shared), each, start)


def with_absent(setting: Setting, model: RTAC) -> RTAC | None:
    """Return a model with every simple candidate that it has not, absent and held; None where its own structure is as quick."""
    simple = _simple(setting)
    more = {effect.id for effect in model.effects} - {effect.id for effect in setting.model.effects}
    if not more or not more <= set(simple):
        return None
    others = [effect for i, effect in simple.items() if i not in model]
    wider = reduce(RTAC.__add__, others, model)
    ids = {effect.id for effect in others}
    return wider.fix(*(name for name in wider.parameters if name.split(".")[0] in ids))


def without_absent(fit: Fit, model: RTAC) -> Fit:
    """Return the fit of a model `with_absent` as that of the model."""
    return dataclasses.replace(fit, model=model.with_values({name: fit.model[name] for name in model.parameters}))


def run_as(
    setting: Setting, added: tuple[str, ...], model: RTAC, free: tuple[str, ...], start: Mapping[str, np.ndarray]
) -> tuple[RTAC, Space, Space]:
    """Return what is run for a model with what was added, the space of that, and the model's own.

    Args:
        setting: of the diagnosis.
        added: ids of the effects beyond the base model.
        model: with them, at the values where a fit begins.
        free: names of its free parameters.
        start: states at the start by name, where they are known.
    """
    own = begun(space_for(setting, model, free), model, start)
    if (common := run_model(setting, added)) is None:
        return model, own, own
    run = common.with_values(model.values)
    return run, begun(padded_space(setting, run, free, room=_ROOM), run, start), own


def of_structure(predictor: Predictor, triangles: np.ndarray, run: Space, own: Space) -> tuple[Predictor, np.ndarray]:
    """Return what was fitted with more parameters and unknowns than a model has, as if that had been fitted by itself.

    Args:
        predictor: that was fitted.
        triangles: factors of its innovations and their derivatives.
        run: its space.
        own: the space of the model.
    """
    if run is own:
        return predictor, triangles
    shared, each, start = predictor.physical
    physical = jnp.asarray(np.asarray(shared)[[run.names.index(name) for name in own.names]]), each, start
    free, padded = len(np.asarray(own.active)), len(np.asarray(run.active))
    unknowns = predictor.unknowns._replace(shared=predictor.unknowns.shared[:free])
    kept = np.delete(triangles, np.s_[free:padded], axis=-1)
    return dataclasses.replace(predictor, unknowns=unknowns, physical=physical), kept
