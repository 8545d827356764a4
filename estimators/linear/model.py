"""A linear model of one condition with its uncertainty, as a record that python-control can take."""

from dataclasses import dataclass
from typing import Any

import control as ct
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Array, Complex128, Float

from estimators.frequency_response.response import FrequencyResponse
from estimators.linear.model_sets import Scale, Sections, Structure, numerator, response, sections
from estimators.linear.residual_tests import ResidualTest
from rtac_jax.programs import program

Curve = Float[np.ndarray, " frequency"]

_UNDAMPED = 1e-6  # damping ratio of a mode that only the bound on stability keeps


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The G and H of one condition, with their uncertainty.

    Attributes:
        name: of the condition.
        structure: the model set.
        names, units: of `values`.
        values: natural frequencies and damping ratios of all modes, by rising frequency, then static gains and rate gains of
            their sections (b s + c) / (s^2 + a_1 s + a_0), c / a_0 and b, and the feedthrough where there is one.
        covariance: of `values`.
        poles, zeros: of G [rad/s].
        poles_std, zeros_std: of their real and imaginary parts [rad/s].
        static_gain, static_gain_std: G(0).
        noise_numerator, noise_denominator: C and D of H in powers of q^-1.
        innovation_std: standard deviation of e, in the output's unit.
        undetermined: number of combinations of unknowns, of G among them, that the data leave free.
        converged: whether the fit came to rest.
        fpe, aic, bic: Akaike's final prediction error [unit of the output squared] and criterion, and the Bayesian one.
        residuals: tests of the prediction errors.
        output, simulated: measured, NaN where it was not, and G u with its start.
        noise_states: of H after each sample.
        signal: the input that drove G, compensated or not.
        sample_time: [s].
        arm_angle: mean over the condition [rad]; None where nothing tells.
        compensated: whether cos(theta) is part of the input.
        channels: names of input and output.
        unknowns: the fitted point of the model set.
        idle: number of combinations of the noise model's unknowns alone that the data leave free, as a pole on a zero.
    """

    name: str
    structure: Structure
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, " quantity"]
    covariance: Float[np.ndarray, "quantity quantity"]
    poles: Complex128[np.ndarray, " pole"]
    zeros: Complex128[np.ndarray, " zero"]
    poles_std: Float[np.ndarray, "pole 2"]
    zeros_std: Float[np.ndarray, "zero 2"]
    static_gain: float
    static_gain_std: float
    noise_numerator: Float[np.ndarray, " power"]
    noise_denominator: Float[np.ndarray, " power"]
    innovation_std: float
    undetermined: int
    converged: bool
    fpe: float
    aic: float
    bic: float
    residuals: ResidualTest
    output: Float[np.ndarray, " sample"]
    simulated: Float[np.ndarray, " sample"]
    noise_states: Float[np.ndarray, "sample order"]
    signal: Float[np.ndarray, " sample"]
    sample_time: float
    arm_angle: float | None
    compensated: bool
    channels: tuple[str, str]
    unknowns: "Unknown"
    idle: int = 0

    @property
    def std(self) -> Float[np.ndarray, " quantity"]:
        """Return the standard deviations of `values`."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def input_rms(self) -> float:
        """Root mean square of the input that drove G."""
        return float(np.sqrt(np.mean(self.signal**2)))

    def state_space(self) -> ct.StateSpace:
        """Return G in continuous time, one block for each mode with its response and the response's slope as states."""
        of = self.unknowns.sections()
        m = len(of.a0)
        a, b, c = np.zeros((2 * m, 2 * m)), np.zeros((2 * m, 1)), np.zeros((1, 2 * m))
        for k in range(m):
            a[2 * k, 2 * k + 1] = 1.0
            a[2 * k + 1, 2 * k : 2 * k + 2] = -of.a0[k], -of.a1[k]
            b[2 * k : 2 * k + 2, 0] = of.b[k], of.c[k] - of.a1[k] * of.b[k]
            c[0, 2 * k] = 1.0
        return ct.StateSpace(a, b, c, np.reshape(of.feedthrough, (1, 1)), name=self.name)

    def transfer_function(self) -> ct.TransferFunction:
        """Return G in continuous time."""
        of = self.unknowns.sections()
        denominator = np.ones(1)
        for a0, a1 in zip(of.a0, of.a1, strict=True):
            denominator = np.convolve(denominator, [1.0, a1, a0])
        found = ct.TransferFunction(np.asarray(self.unknowns.numerator()), denominator)
        found.name = self.name
        return found

    def noise_model(self) -> ct.TransferFunction:
        """Return H, in discrete time."""
        return ct.TransferFunction(self.noise_numerator, self.noise_denominator, self.sample_time)

    def frequency_response(self, omega: Curve) -> FrequencyResponse:
        """Return G on a grid [rad/s], with the standard deviation that the parameters' covariance gives it."""
        value, slope = self.unknowns.response(omega)
        std = np.sqrt(np.einsum("rfp,pq,rfq->f", slope, self.unknowns.covariance, slope))
        found = value[0] + 1j * value[1]
        as_it_is: Any = False
        frequency, density = scipy.signal.welch(
            self.signal, 1 / self.sample_time, detrend=as_it_is, nperseg=min(1024, len(self.signal))
        )
        into = np.interp(omega, 2 * np.pi * frequency, density)
        z = np.exp(1j * omega * self.sample_time)
        shape = np.polyval(self.noise_numerator, z) / np.polyval(self.noise_denominator, z)
        noise = 2 * self.sample_time * self.innovation_std**2 * np.abs(shape) ** 2
        power = np.abs(found) ** 2 * into
        freedom = max(int(np.sum(np.isfinite(self.output))) - self.structure.count, 1)
        return FrequencyResponse(
            name=self.name, frequency=np.asarray(omega, dtype=np.float64), response=found, std=std, noise_std=std,
            freedom=freedom, odd_distortion=None, even_distortion=None, coherence=power / (power + noise),
            input_rms=self.input_rms, arm_angle=self.arm_angle, compensated=self.compensated,
            input=self.channels[0], output=self.channels[1],
        )  # fmt: skip

    def predict(self, horizon: int | None = 1) -> Float[np.ndarray, " sample"]:
        """Predict the output from the input and outputs at least `horizon` samples old; with None from the input alone.

        Raises:
            ValueError: the horizon is not positive.
        """
        if horizon is None:
            return self.simulated
        if horizon < 1:
            raise ValueError(f"horizon: is {horizon}; give at least 1 sample, or None for a simulation.")
        order = self.noise_states.shape[1]
        found = self.simulated.copy()
        if order == 0 or horizon >= len(found):
            return found
        d = np.concatenate([self.noise_denominator[1:], np.zeros(order + 1 - len(self.noise_denominator))])
        move = np.eye(order, k=1)
        move[:, 0] -= d
        found[horizon:] += self.noise_states[:-horizon] @ np.linalg.matrix_power(move, horizon - 1)[0]
        return found

    def fit_percent(self, horizon: int | None = None) -> float:
        """Return 100 (1 - |y - yhat| / |y - mean y|) of the prediction; of simulation by default."""
        here = np.isfinite(self.output)
        error = (self.output - self.predict(horizon))[here]
        return 100 * float(1 - np.linalg.norm(error) / np.linalg.norm(self.output[here] - np.mean(self.output[here])))

    @property
    def undamped(self) -> bool:
        """Return whether only the bound on stability keeps a mode, which then stands for noise."""
        poles: Any = self.poles
        return bool(np.min(np.abs(poles.real) / np.abs(poles)) < _UNDAMPED)

    @property
    def fewer(self) -> str:
        """Return in words what has fewer unknowns."""
        shares_poles = self.structure.kind in ("armax", "state_space")
        return f"fewer modes or {'a structure whose noise has poles of its own' if shares_poles else 'noise_order'}"

    @property
    def verdict(self) -> str:
        """Return the verdict of the residual tests, and what else is wrong with the fit."""
        said = self.residuals.verdict(self.structure.noise > 0)
        if self.undetermined:
            said += f"; the data leave {self.undetermined} combination(s) of unknowns free: {self.fewer} would do"
        elif self.idle:
            said += "; noise_order is higher than the noise needs, which leaves G as it is"
        elif not self.converged:
            said += "; the fit did not come to rest, so compare it with another start"
        if self.undamped:
            said += "; a mode is held by the bound on stability alone: it stands for noise, and fewer modes would do, or the plant "
            said += "is not stable"
        return said


@dataclass(frozen=True, eq=False)
class Unknown:
    """A fitted point of the model set, from which quantities and their derivatives come.

    Attributes:
        structure: the set.
        theta: the unknowns.
        covariance: of the unknowns.
        scale: output, and output over input.
    """

    structure: Structure
    theta: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    scale: Scale

    def sections(self) -> Any:
        """Return G's `Sections`, as NumPy arrays."""
        return jax.tree.map(np.asarray, _sections(self.structure, jnp.asarray(self.theta), self.scale))

    def numerator(self) -> Float[np.ndarray, " power"]:
        """Return G's numerator in falling powers; leading coefficients that are zero by structure are left out."""
        return np.asarray(_numerator(self.structure, jnp.asarray(self.theta), self.scale)[0])

    def response(
        self, omega: Curve
    ) -> tuple[Float[np.ndarray, "2 frequency"], Float[np.ndarray, "2 frequency unknown"]]:
        """Return real and imaginary part of G, and their derivatives."""
        value, slope = _response(self.structure, jnp.asarray(self.theta), self.scale, jnp.asarray(omega))
        return np.asarray(value), np.asarray(slope)

    def roots(self) -> tuple[Any, Any, Any, Any]:
        """Return poles and zeros, and standard deviations of their real and imaginary parts."""
        (poles, of_poles), (zeros, of_zeros) = self.root_covariances()
        std = [np.sqrt(np.diagonal(c, axis1=1, axis2=2)) for c in (of_poles, of_zeros)]
        return poles, std[0], zeros, std[1]

    def root_covariances(self) -> list[tuple[Any, Float[np.ndarray, "root 2 2"]]]:
        """Return poles, then zeros, each with the covariance of their real and imaginary parts."""
        (top, below), (d_top, d_below) = (
            [np.asarray(x) for x in part]
            for part in _numerator_and_denominator(self.structure, jnp.asarray(self.theta), self.scale)
        )
        found = []
        for polynomial, slope in ((below, d_below), (top, d_top)):
            roots = np.roots(polynomial).astype(np.complex128)
            roots = roots[np.argsort(np.abs(roots), kind="stable")]
            change = np.stack([np.polyval(column, roots) for column in slope.T], axis=1)
            moved = -change / np.polyval(np.polyder(polynomial), roots)[:, None]
            parts = np.stack([moved.real, moved.imag], axis=1)
            found.append((roots, np.einsum("rip,pq,rjq->rij", parts, self.covariance, parts)))
        return found

    def quantities(self) -> tuple[Float[np.ndarray, " quantity"], Float[np.ndarray, "quantity unknown"]]:
        """Return natural frequencies, damping ratios, gains, feedthrough, modes by rising frequency; and their derivatives."""
        value, slope = (np.asarray(x) for x in _quantities(self.structure, jnp.asarray(self.theta), self.scale))
        m = self.structure.modes
        order = np.argsort(value[:m])
        places = np.concatenate([order + m * block for block in range(4)] + [np.arange(4 * m, len(value))])
        if self.structure.zeros == 2 * m - 2:
            places = places[:-1]  # the rate gains sum up to zero
        return value[places], slope[places]


@program
def _sections(structure: Structure, theta: Array, scale: Scale) -> Sections:
    return sections(structure, theta, scale)


def _top(structure: Structure, theta: Array, scale: Scale) -> Array:
    whole = numerator(sections(structure, theta, scale))
    return whole[2 * structure.modes - structure.zeros :]


@program
def _numerator(structure: Structure, theta: Array, scale: Scale) -> tuple[Array]:
    return (_top(structure, theta, scale),)


@program
def _numerator_and_denominator(structure: Structure, theta: Array, scale: Scale) -> Any:
    def both(t: Array) -> tuple[Array, Array]:
        of = sections(structure, t, scale)
        below = jnp.ones(1)
        for k in range(structure.modes):
            below = jnp.convolve(below, jnp.stack([jnp.ones(()), of.a1[k], of.a0[k]]))
        return _top(structure, t, scale), below

    return both(theta), jax.jacfwd(both)(theta)


@program
def _response(structure: Structure, theta: Array, scale: Scale, omega: Array) -> tuple[Array, Array]:
    def function(t: Array) -> Array:
        return response(sections(structure, t, scale), omega)

    return function(theta), jax.jacfwd(function)(theta)


@program
def _quantities(structure: Structure, theta: Array, scale: Scale) -> tuple[Array, Array]:
    def function(t: Array) -> Array:
        of = sections(structure, t, scale)
        rate = jnp.sqrt(of.a0)
        parts = [rate, of.a1 / (2 * rate), of.c / of.a0, of.b]
        if structure.zeros == 2 * structure.modes:
            parts.append(of.feedthrough[None])
        return jnp.concatenate(parts)

    return function(theta), jax.jacfwd(function)(theta)
