"""The predictor of the base model, which a diagnosis fits first, and what is compiled for it ahead."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from estimators.closed_form.fit import starting_values
from estimators.core.progress import Progress
from estimators.core.results import DivergedError
from estimators.diagnosis.innovation_tests import pieces_of_tests
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import fitted
from estimators.diagnosis.setting import Setting, model_with, set_up, shared
from estimators.diagnosis.shared_structure import run_as
from estimators.prediction_error.coloured_noise import with_colours
from estimators.prediction_error.filter_pass import without_shaken
from estimators.prediction_error.noise_estimation import compile_predictor
from estimators.prediction_error.predictive_steps import predictive_substeps
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording


def compile_for(model: RTAC, recording: Recording, classes: Sequence[type[Effect]], *, part: bool) -> None:
    """Compile what the diagnosis of a model will run first, so that this can be done while the model is fitted.

    Args:
        model: that is fitted.
        recording: that will be diagnosed.
        classes: of the candidates.
        part: whether it is a part of what is fitted.
    """
    setting = set_up(model, recording, classes, {}, 1, Progress("compile", show=False))
    setting = dataclasses.replace(setting, part=part)
    for piece in pieces_of_tests(setting):  # first: a fit begins with the filter too, and compiles it
        piece()
    _compile_base(setting)


def compile_base(setting: Setting) -> None:
    """Compile what `fit_base` will run after the filter, which it begins with and compiles itself."""
    _compile_base(setting, noise=False)


def with_predictive_steps(setting: Setting) -> Setting:
    """Return the setting with as few steps of integration in a sample as its predictions need; a free simulation may need more."""
    most = int(setting.substeps)
    model, space, _ = run_as(setting, (), model_with(setting, []), tuple(shared(setting.model)), {})
    physical = (space.values, space.each_values, space.start)
    fewest = predictive_substeps(model, setting.data, space, physical, setting.prior.starting(space), most)
    return dataclasses.replace(setting, substeps=jnp.asarray(fewest))


def fit_base(setting: Setting) -> Refit:
    """Fit the base model.

    It begins where the fit that is diagnosed ended; where that has run away, and predictions diverge there, in closed form.

    Raises:
        DivergedError: they diverge there, too.
    """
    free = tuple(shared(setting.model))
    try:
        return fitted(setting, (), model_with(setting, []), free, None, {})
    except (FloatingPointError, np.linalg.LinAlgError):
        model = with_colours(starting_values(setting.model, setting.recording), setting.colours)
    try:
        return fitted(setting, (), model, free, None, {})
    except (FloatingPointError, np.linalg.LinAlgError) as error:
        own = [effect.id for effect in setting.model.effects if effect.states]
        without = f" Diagnose it without what has states of its own: {', '.join(own)} (model.without)." if own else ""
        raise DivergedError(
            f"Predictions one sample ahead diverge with this model, from the fit's values and from the closed form's.{without}"
        ) from error


def trusting(setting: Setting, base: Refit) -> tuple[Setting, Refit]:
    """Return the setting, and the base model fitted again, where no stick-slip ambiguous sample counts.

    The samples are those of the base model, for all models: likelihoods compare only where they count the same
    data.
    """
    if not np.any(base.predictor.filtered.shaken):
        return setting, base
    trusted = dataclasses.replace(setting, data=without_shaken(setting.data, base.predictor.filtered))
    model = base.model.with_values(base.values)
    return trusted, fitted(trusted, (), model, base.free, base.predictor.noise, base.start)


def _compile_base(setting: Setting, *, noise: bool = True) -> None:
    model, space, _ = run_as(setting, (), model_with(setting, []), tuple(shared(setting.model)), {})
    compile_predictor(model, setting.data, space, setting.prior.starting(space), setting.substeps, noise=noise)
