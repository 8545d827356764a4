"""The maximum of the likelihood without derivatives, for effects on which it depends by steps."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from estimators._likelihood import NoiseModel, fit_noise, run_filter
from estimators._problem import Data, Space
from rtac_jax import RTAC
from rtac_jax._simulate import Steps

# Logarithm of the variance of random forces, in shares of the rms forces, above which they take over what they should not.
_FEW = -4.0
_TRIALS = 150
_LITTLE = 0.5  # change in log-likelihood that is not worth another trial
_FINE = 1e-4
_DIVERGED = 1e12  # negative log-likelihood: a simplex cannot compare infinities
_SMALL = 1e-3  # of its scale, the least size of a parameter that steps are a share of
_BODY = {"arm": ("arm_inertia", "torque_constant"), "cart": ("total_mass", "spring_stiffness")}


@dataclasses.dataclass(frozen=True)
class Tried:
    """Parameters, and the noise that is likeliest with them.

    Attributes:
        space: with the parameters as its values.
        noise: logarithms of the process variances and of the sensors' variance ratios.
        log_likelihood: there.
    """

    space: Space
    noise: Float[np.ndarray, " noise"]
    log_likelihood: float


def acting_on(port: str, model: RTAC, free: Sequence[str]) -> tuple[str, ...]:
    """Those of some parameters that move when a contact at a port begins and ends: of what acts there, and of the motor."""
    effects = {effect.id for effect in model.effects if port in effect.port or effect.port == "actuator"}
    return tuple(name for name in free if name.split(".")[0] in effects or name in _BODY.get(port, ()))


def tried(
    model: RTAC, data: Data, space: Space, prior: NoiseModel, noise: Float[np.ndarray, " noise"], substeps: Steps
) -> Tried:
    """The values of a space, with the noise that is likeliest there, sought from a noise."""
    physical = space.physical(space.unconstrained(start=False))
    found = fit_noise(model, data, space, physical, prior, noise, substeps)
    return Tried(space, found.exponents, found.log_likelihood)


def climbed_by_trial(
    model: RTAC, data: Data, first: Tried, prior: NoiseModel, substeps: Steps, *, side: float
) -> Tried:
    """Move the free shared parameters of the space by the simplex of Nelder and Mead, which asks only how likely the data are.

    The noise stays meanwhile, for a pass of the filter costs a tenth of what fitting it does, and is fitted at the end.

    Args:
        side: of the first simplex, in unconstrained numbers: half of that is the share by which a parameter with one bound moves.

    Source: Nelder and Mead, The Computer Journal 7 (1965); Gao and Han, Computational Optimization and Applications 51 (2012)
    for more than a few parameters.
    """
    values = np.asarray(first.space.values)
    sizes = np.maximum(np.abs(values), _SMALL * np.asarray(first.space.scale))
    scaled = dataclasses.replace(first.space, scale=jnp.asarray(sizes))
    centre = scaled.unconstrained(start=False)
    here, noise = np.asarray(centre.shared), first.noise

    def physical(at: np.ndarray) -> tuple[Any, Any, Any]:
        return scaled.physical(centre._replace(shared=jnp.asarray(at)))

    def cost(at: np.ndarray) -> float:
        value = float(run_filter(model, data, first.space, physical(at), prior, noise, substeps).value)
        return value if np.isfinite(value) else _DIVERGED

    simplex = np.vstack([here, here + side * np.eye(len(here))])
    options = {"maxfev": _TRIALS, "adaptive": True, "initial_simplex": simplex, "xatol": _FINE, "fatol": _LITTLE}
    there = physical(minimize(cost, here, method="Nelder-Mead", options=options).x)[0]
    return tried(model, data, dataclasses.replace(first.space, values=there), prior, noise, substeps)


def few_random_forces(noise: Float[np.ndarray, " noise"]) -> Float[np.ndarray, " noise"]:
    """The same with no more random force and torque than where physics that is wrong may still be mended."""
    return np.concatenate([np.minimum(noise[:2], _FEW), noise[2:]])
