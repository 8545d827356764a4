"""Maximisation of the likelihood without derivatives, for effects on which it depends by steps."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from estimators.core.data import Data
from estimators.core.deadline import OutOfTimeError, require_time
from estimators.core.parameter_space import Physical, Space
from estimators.core.threads import at_once
from estimators.diagnosis.refit import Refit
from estimators.prediction_error.filter_pass import negative_log_likelihood
from estimators.prediction_error.noise_estimation import fit_noise
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.parameters import declarations
from rtac_jax.simulation import Steps

# Logarithm of the variance of random forces, in fractions of the rms forces, above which they take over what they should not.
_FEW = -4.0
_SOME = -2.0  # the same, once trials have come near
_TRIED = 3000  # samples of every experiment that trials are of: hundreds of passes are made of them
_TRIALS = 150
_SIDES = (0.6, 0.3, 0.2, 0.1, 0.05)  # of the first simplex of trials, one sweep after the other
_WORTH_A_SWEEP = (10.0, 0.003)  # gain in log-likelihood, and fraction of all that was gained, worth a sweep
_SIZES = tuple(2.0 ** (power / 2) for power in range(-2, 7))  # of what is plausible, from which trials may begin
_SHAPES = (1 / 3, 2 / 3, 3 / 2, 2.0, 8 / 3)  # the same of a parameter that only shapes the effect
_LITTLE = 0.5  # change in log-likelihood that is not worth another trial
_FINE = 0.01  # of unconstrained numbers: half a percent of a size
_DIVERGED = 1e12  # negative log-likelihood: a simplex cannot compare infinities
_SMALL = 0.05  # of its scale, the least size of a parameter that steps are a fraction of
_REACH = 3.0  # of unconstrained numbers: from a parameter at its bound, infinitely far, no step leads away
_ARM = ("arm_inertia", "torque_constant")


def acting_on_arm(model: RTAC, free: Sequence[str]) -> tuple[str, ...]:
    """Return those of some parameters that move when a contact begins and ends.

    A contact strikes the arm, which the motor drives.
    """
    effects = {effect.id for effect in model.effects if "arm" in effect.port or effect.port == "actuator"}
    return tuple(name for name in free if name in _ARM or name.split(".")[0] in effects)


def trial_data(data: Data) -> Data:
    """Return the data that trials are of: the beginning of every experiment tells where a contact is."""
    return data.beginning(_TRIED)


def begins_of(effect: Effect, amplitudes: Sequence[str]) -> list[dict[str, float]]:
    """Return starting values of an effect's parameters for trials: several sizes, each with several values of each shape."""
    declared = declarations(effect)
    plausible = {name: float(np.asarray(getattr(effect, name))) for name in declared}
    shapes = [plausible]
    for name, declaration in declared.items():
        low, high = declaration.bounds
        if name not in amplitudes and not declaration.fixed:
            several = (multiple * plausible[name] for multiple in _SHAPES)
            shapes += [plausible | {name: value} for value in several if low < value < high]
    return [{n: size * v if n in amplitudes else v for n, v in shape.items()} for size in _SIZES for shape in shapes]


def likeliest_begin(
    model: RTAC,
    data: Data,
    spaces: Sequence[Space],
    prior: NoiseModel,
    noise: Float[np.ndarray, " noise"],
    substeps: Steps,
) -> Space:
    """Return that of several spaces whose values make the data likeliest with a given noise; it is not fitted.

    With its likeliest noise a model without the contact does better than one with the right play and a rotor a little too
    heavy: large random forces make good for what is left out, and none for what comes at the wrong time.
    """

    def cost(space: Space) -> float:
        return _cost(model, data, space, (space.values, space.each_values, space.start), prior, noise, substeps)

    return spaces[int(np.argmin(at_once(cost, spaces)))]


def climbed_by_trial(
    model: RTAC,
    data: Data,
    space: Space,
    prior: NoiseModel,
    noise: Float[np.ndarray, " noise"],
    substeps: Steps,
    *,
    side: float,
) -> tuple[Space, Float[np.ndarray, " noise"]]:
    """Move the free shared parameters by the simplex of Nelder and Mead, which asks only how likely the data are.

    The noise stays meanwhile, for a pass of the filter costs a tenth of what fitting it does, and is fitted at the end.

    Args:
        model: of the physics.
        data: of all experiments.
        space: with the values to begin at.
        prior: of the noise.
        noise: logarithms of the process variances and of the sensors' variance ratios.
        substeps: of the integrator in each sample.
        side: of the first simplex, in unconstrained numbers: half of that is the relative change of a parameter with one bound.

    Returns:
        The space with other values, and the noise that is likeliest with them.

    Source: Nelder and Mead, The Computer Journal 7 (1965); Gao and Han, Computational Optimization and Applications 51 (2012)
    for more than a few parameters.
    """
    sizes = np.maximum(np.abs(np.asarray(space.values)), _SMALL * np.asarray(space.scale))
    scaled = dataclasses.replace(space, scale=jnp.asarray(sizes))
    centre = scaled.unconstrained(start=False)
    here = np.clip(np.asarray(centre.shared), -_REACH, _REACH)

    def physical(at: np.ndarray) -> tuple[Any, Any, Any]:
        return scaled.physical(centre._replace(shared=jnp.asarray(at)))

    def cost(at: np.ndarray) -> float:
        return _cost(model, data, space, physical(at), prior, noise, substeps)

    simplex = np.vstack([here, here + side * np.eye(len(here))])
    options = {"maxfev": _TRIALS, "adaptive": True, "initial_simplex": simplex, "xatol": _FINE, "fatol": _LITTLE}
    there = physical(minimize(cost, here, method="Nelder-Mead", options=options).x)
    moved = dataclasses.replace(space, values=there[0])
    return moved, fit_noise(model, data, moved, there, prior, noise, substeps).exponents


def in_turn(
    space: Space,
    before: Refit,
    climbed: Callable[[Space, Float[np.ndarray, " noise"], float], tuple[Space, Float[np.ndarray, " noise"]]],
    fitted: Callable[[Space, Float[np.ndarray, " noise"]], tuple[Refit, Space]],
) -> Refit:
    """Return the likeliest of the fits that follow trials, each begun where the likeliest fit before it ended.

    Args:
        space: with the values to begin at.
        before: the model before, from whose noise it begins.
        climbed: moves a space by trials from a noise, with a first simplex of a given side.
        fitted: a fit from there, and the space with its values.

    Raises:
        ArithmeticError: every fit did.
    """
    noise = few_random_forces(before.predictor.noise)
    best: tuple[Refit, Space] | None = None
    for side in _SIDES:
        last = before if best is None else best[0]
        gained = 0.0
        try:
            space, noise = climbed(space, noise, side)
            now = fitted(space, noise)
        except ArithmeticError:
            pass
        except OutOfTimeError:
            if best is None:
                raise
            break
        else:
            gained = now[0].predictor.log_likelihood - last.predictor.log_likelihood
            if best is None or gained > 0:
                best = now
        if best is not None:
            space, noise = best[1], best[0].predictor.noise
        noise = few_random_forces(noise, _SOME)
        least, fraction = _WORTH_A_SWEEP
        all_gained = last.predictor.log_likelihood + gained - before.predictor.log_likelihood
        if best is not None and not gained > max(least, fraction * all_gained):
            break
    if best is None:
        raise FloatingPointError("the model diverges, or leaves parameters free, after all trials.")
    return best[0]


def few_random_forces(noise: Float[np.ndarray, " noise"], most: float = _FEW) -> Float[np.ndarray, " noise"]:
    """Return the noise with limited random force and torque.

    They are no more than where physics that is wrong may still be mended.
    """
    return np.concatenate([np.minimum(noise[:2], most), noise[2:]])


def _cost(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    prior: NoiseModel,
    noise: Float[np.ndarray, " noise"],
    substeps: Steps,
) -> float:
    require_time()
    value = negative_log_likelihood(model, data, space, physical, prior, noise, substeps)
    return value if np.isfinite(value) else _DIVERGED
