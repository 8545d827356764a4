"""Linear model sets y = G u + H e: their parameters, and the predictor that goes with them."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STRUCTURES = ("output_error", "armax", "box_jenkins", "state_space")

_RATES = 30.0  # powers of e beyond which rates and dampings are held, so that a wild trial step stays finite


@dataclass(frozen=True)
class Structure:
    """A model set of the paper's section 5.1 for one input and one output.

    G is a sum of `modes` sections (b s + c) / (s^2 + a_1 s + a_0) with a_0, a_1 > 0, so that it is stable whatever the
    parameters, with real or complex poles. H = C(q) / D(q) is monic; both are made from reflection coefficients between -1
    and 1, so that H and its inverse, and with them the predictor, are stable.

    Attributes:
        kind: "output_error", H = 1; "box_jenkins", C and D free; "armax", D the sampled denominator of G, C of order
            `noise_order`; "state_space", the innovations form x+ = F x + G u + K e with K free, which for one output is
            the same set as ARMAX with C of full order.
        modes: pairs of poles of G.
        zeros: of G: `2 modes`, with a direct feedthrough, `2 modes - 1`, or `2 modes - 2`, as from force to position.
        noise_order: order of C, and of D where that is free.
    """

    kind: str
    modes: int
    zeros: int
    noise_order: int

    @property
    def residues(self) -> int:
        """Free coefficients b and c of the sections, and the feedthrough."""
        return self.zeros + 1

    @property
    def dynamics(self) -> int:
        """Parameters of G."""
        return 2 * self.modes + self.residues

    @property
    def moving_average(self) -> int:
        """Order of C."""
        return 0 if self.kind == "output_error" else self.noise_order

    @property
    def autoregressive(self) -> int:
        """Free coefficients of D."""
        return self.noise_order if self.kind == "box_jenkins" else 0

    @property
    def noise(self) -> int:
        """Parameters of H."""
        return self.moving_average + self.autoregressive

    @property
    def noise_starts(self) -> int:
        """States of H at the start. Taken as zero they would bend G's, except where H has G's poles and these stand for both."""
        return self.noise_order if self.kind == "box_jenkins" else 0

    @property
    def count(self) -> int:
        """Return all unknowns: G, H, the start of G and the start of H, in this order."""
        return self.dynamics + self.noise + 2 * self.modes + self.noise_starts

    def with_modes(self, modes: int) -> "Structure":
        """Return the same set with another number of modes."""
        order = 2 * modes if self.kind == "state_space" else self.noise_order
        return Structure(self.kind, modes, self.zeros + 2 * (modes - self.modes), order)


class Scale(NamedTuple):
    """The sizes of a condition that make unknowns and errors of order one: output, output over input, prediction error."""

    output: Float[Array, "*condition"]
    gain: Float[Array, "*condition"]
    error: Float[Array, "*condition"]


class Sections(NamedTuple):
    """The sections (b s + c) / (s^2 + a_1 s + a_0) whose sum is G in continuous time, and a feedthrough."""

    a0: Float[Array, " mode"]
    a1: Float[Array, " mode"]
    b: Float[Array, " mode"]
    c: Float[Array, " mode"]
    feedthrough: Float[Array, ""]


class Sampled(NamedTuple):
    """The coefficients of the predictor.

    Attributes:
        transition: of the states (y_k, slope of y_k) of each section over one sample.
        drive: what the powers of the input's polynomial over the interval add to them.
        feedthrough: of the input.
        c, d: of H = C / D, without the leading one.
        start: states of the sections.
        noise_start: states of H.
    """

    transition: Float[Array, "mode 2 2"]
    drive: Float[Array, "mode 2 power"]
    feedthrough: Float[Array, ""]
    c: Float[Array, " order"]
    d: Float[Array, " order"]
    start: Float[Array, "mode 2"]
    noise_start: Float[Array, " order"]


def sections(structure: Structure, theta: Float[Array, " unknown"], scale: Scale) -> Sections:
    """Return G in physical units from the unknowns."""
    m = structure.modes
    rate = jnp.exp(jnp.clip(theta[:m], -_RATES, _RATES))
    a1 = jnp.exp(jnp.clip(theta[m : 2 * m], -_RATES, _RATES))
    residues = scale.gain * theta[2 * m : structure.dynamics]
    slow = residues[:m] * rate**2
    fast = residues[m:]
    feedthrough = jnp.zeros(())
    if structure.zeros == 2 * m:
        fast, feedthrough = fast[:-1], fast[-1]
    elif structure.zeros == 2 * m - 2:
        # What is left of s^(2m-1) in the numerator is the sum of the b: relative degree two where they cancel.
        fast = jnp.append(fast * rate[:-1], -jnp.sum(fast * rate[:-1])) / rate
    return Sections(rate**2, a1, fast * rate, slow, feedthrough)


def sampled(
    structure: Structure, theta: Float[Array, " unknown"], scale: Scale, interval: Float[Array, ""], powers: int
) -> Sampled:
    """Discretise G exactly for an input that is a polynomial between samples; one power is a held input.

    Source: Van Loan, IEEE Trans. Automatic Control 23 (1978), for the integral of the matrix exponential.
    """
    of = sections(structure, theta, scale)
    m, first = structure.modes, structure.dynamics + structure.noise
    zero, one = jnp.zeros(m), jnp.ones(m)
    a = jnp.stack([jnp.stack([zero, one], -1), jnp.stack([-of.a0, -of.a1], -1)], -2)
    b = jnp.stack([of.b, of.c - of.a1 * of.b], -1)
    whole = jnp.zeros((m, 2 + powers, 2 + powers))
    whole = whole.at[:, :2, :2].set(interval * a).at[:, :2, 2].set(interval * b)
    for j in range(powers - 1):
        whole = whole.at[:, 2 + j, 3 + j].set(1.0)
    moved = jax.vmap(jax.scipy.linalg.expm)(whole)
    # The state of the input's chain is its derivatives: the power j starts it at j!.
    drive = moved[:, :2, 2:] * jnp.asarray([float(math.factorial(j)) for j in range(powers)])
    last = first + 2 * m
    start = scale.output * theta[first:last].reshape(m, 2) * jnp.stack([one, jnp.sqrt(of.a0)], -1)
    noise = theta[structure.dynamics : first]
    c = monic(noise[: structure.moving_average])
    if structure.autoregressive:
        d = monic(noise[structure.moving_average :])
    elif structure.noise:
        d = _characteristic(moved[:, :2, :2])
    else:
        d = jnp.zeros(0)
    order = max(len(c), len(d))
    c, d = (jnp.pad(x, (0, order - len(x))) for x in (c, d))
    noise_start = jnp.pad(scale.output * theta[last:], (0, order - len(theta[last:])))
    return Sampled(moved[:, :2, :2], drive, of.feedthrough, c, d, start, noise_start)


def numerator(of: Sections) -> Float[Array, " power"]:
    """Return the coefficients of G's numerator over the product of all sections' denominators.

    They are in falling powers, without leading zeros.
    """
    modes = len(of.a0)
    each = [jnp.stack([jnp.ones(()), of.a1[k], of.a0[k]]) for k in range(modes)]
    whole = jnp.ones(1)
    for factor in each:
        whole = jnp.convolve(whole, factor)
    total = of.feedthrough * whole
    for k in range(modes):
        part = jnp.stack([of.b[k], of.c[k]])
        for j in range(modes):
            if j != k:
                part = jnp.convolve(part, each[j])
        total = total.at[1:].add(part)
    return total


def response(of: Sections, omega: Float[Array, " frequency"]) -> Float[Array, "2 frequency"]:
    """Return real and imaginary part of G(j omega)."""
    s = 1j * omega[:, None]
    found = jnp.sum((of.b * s + of.c) / (s * s + of.a1 * s + of.a0), axis=1) + of.feedthrough
    return jnp.stack([found.real, found.imag])


def monic(reflections: Float[Array, " order"]) -> Float[Array, " order"]:
    """Return coefficients of q^-1 ... q^-n of a stable monic polynomial; tanh of each number is a reflection coefficient.

    Every stable polynomial is reached, by one set of numbers only.
    Source: Barndorff-Nielsen and Schou, J. Multivariate Analysis 3 (1973).
    """
    found = jnp.zeros(0)
    for number in range(len(reflections)):
        k = jnp.tanh(reflections[number])
        found = jnp.append(found + k * found[::-1], k)
    return found


def _characteristic(transition: Float[Array, "mode 2 2"]) -> Float[Array, " order"]:
    """Return the coefficients of q^-1 ... of the product of all sections' characteristic polynomials."""
    found = jnp.ones(1)
    for each in transition:
        found = jnp.convolve(found, jnp.stack([jnp.ones(()), -jnp.trace(each), jnp.linalg.det(each)]))
    return found[1:]
