"""Frequency response, poles and zeros of a fitted physical model, with what the covariance of its parameters makes of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import control as ct
import numpy as np
from jaxtyping import Complex128, Float

from estimators.core.fit import Fit
from estimators.frequency_response.response import FrequencyResponse
from estimators.prediction_error.fit import PredictorFit
from rtac_jax import RTAC, linearise
from rtac_jax.arguments import checked_arguments
from rtac_jax.equations import dead_time

_STEP = 1e-2  # of a central difference, in standard deviations of the parameter: small against what matters, large beside rounding
_SURE = 1_000_000  # degrees of freedom of a band that counts the parameters alone
_CANCELS = 1e-6  # distance of a pole from a zero, relative to the fastest pole, below which neither shows


@checked_arguments
def model_response(
    fit: Fit | PredictorFit, omega: Float[np.ndarray, " frequency"], *, arm_angle: float = 0.0
) -> FrequencyResponse:
    """Return the frequency response of a fitted model, linearised, with the standard deviation of its parameters.

    It is the response from current times cos(theta) to cart position, as `frequency_responses` measures it.

    Args:
        fit: of a physical model.
        omega: frequencies [rad/s].
        arm_angle: about which the model is linearised [rad].

    Raises:
        ValueError: as `rtac_jax.linearise`, or the arm pushes the cart nowhere at this angle.

    Source: Gauss' approximation formula; Ljung, System Identification (1999), section 9.4 and appendix 9B.
    """
    along = float(np.cos(arm_angle))
    if abs(along) < 1e-3:
        raise ValueError(
            f"arm_angle: is {arm_angle:g}, where the arm does not push the cart; choose one nearer to 0 or pi."
        )

    def of(model: RTAC) -> Float[np.ndarray, " part"]:
        late = np.exp(-1j * omega * float(dead_time(model)))
        response = np.asarray(_plant(model, arm_angle)(1j * omega)).ravel() * late / along
        return np.concatenate([response.real, response.imag])

    value, slope = _moved(fit, of)
    spread = np.sqrt(np.einsum("fp,pq,fq->f", slope, fit.information.own_covariance, slope)).reshape(2, -1)
    response = value[: len(omega)] + 1j * value[len(omega) :]
    std = np.hypot(spread[0], spread[1])
    return FrequencyResponse(
        name="fitted model", frequency=np.asarray(omega, dtype=np.float64), response=response, std=std, noise_std=std,
        freedom=_SURE, odd_distortion=None, even_distortion=None, coherence=np.ones(len(omega)), input_rms=float("nan"),
        arm_angle=arm_angle, compensated=True,
    )  # fmt: skip


class Roots(NamedTuple):
    """Poles or zeros with their uncertainty.

    Attributes:
        values: [rad/s].
        covariance: of real and imaginary part.
    """

    values: Complex128[np.ndarray, " root"]
    covariance: Float[np.ndarray, "root 2 2"]


def model_roots(fit: Fit | PredictorFit, *, arm_angle: float = 0.0) -> tuple[Roots, Roots]:
    """Return poles and zeros from current to cart position of a fitted model, linearised; those that cancel are left out.

    Args:
        fit: of a physical model.
        arm_angle: about which the model is linearised [rad].

    Raises:
        ValueError: as `rtac_jax.linearise`.
    """
    first = _poles_and_zeros(fit.model, arm_angle)
    fastest = float(np.max(np.abs(first[0]), initial=1e-300))
    paired = [np.full(len(one), False) for one in first]
    for i, pole in enumerate(first[0]):
        near = [j for j in np.flatnonzero(~paired[1]) if abs(first[1][j] - pole) < _CANCELS * fastest]
        if near:
            paired[0][i] = paired[1][near[0]] = True
    result = []
    for number, hidden in enumerate(paired):
        kept = first[number][~hidden]

        def of(model: RTAC, kept: np.ndarray = kept, number: int = number) -> Float[np.ndarray, " part"]:
            moved: Any = _nearest(kept, _poles_and_zeros(model, arm_angle)[number])
            return np.concatenate([moved.real, moved.imag])

        value, slope = _moved(fit, of)
        parts = slope.reshape(2, len(kept), -1)
        covariance = np.einsum("irp,pq,jrq->rij", parts, fit.information.own_covariance, parts)
        result.append(Roots(value[: len(kept)] + 1j * value[len(kept) :], covariance))
    return result[0], result[1]


def _plant(model: RTAC, arm_angle: float) -> ct.StateSpace:
    """Return the plant from the current as it flows, after any dead time."""
    return linearise(model, arm_angle=arm_angle, drive="current", delay_order=0)["cart_position", "current"]


def _poles_and_zeros(model: RTAC, arm_angle: float) -> tuple[np.ndarray, np.ndarray]:
    plant = _plant(model, arm_angle)
    return np.asarray(plant.poles(), dtype=complex), np.asarray(plant.zeros(), dtype=complex)


def _nearest(roots: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return for each root the one of the others that lies nearest, each taken once."""
    left = list(among)
    return np.array([left.pop(int(np.argmin(np.abs(np.array(left) - root)))) for root in roots], dtype=complex)


def _moved(
    fit: Fit | PredictorFit, of: Callable[[RTAC], Float[np.ndarray, " part"]]
) -> tuple[Float[np.ndarray, " part"], Float[np.ndarray, "part parameter"]]:
    """Return a function of the model, and its derivatives by the free parameters, as central differences."""
    model = fit.model.with_values({name: np.mean(fit.model[name]) for name in fit.model.per_experiment})
    columns = []
    for name, variance in zip(fit.information.names, np.diagonal(fit.information.own_covariance), strict=True):
        step, value = _STEP * float(np.sqrt(variance)), float(np.asarray(model[name]))
        ahead, behind = (of(model.with_values({name: value + sign * step})) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    value = of(model)
    return value, np.stack(columns, axis=1) if columns else np.zeros((len(value), 0))
