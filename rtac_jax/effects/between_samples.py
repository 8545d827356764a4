"""Input effects: a behaviour of the inputs between and across their samples other than was declared.

Inputs are known before anything moves, so these effects change their polynomials and cost the time loop nothing.
"""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Input, Pieces
from rtac_jax.excitation import BEYOND
from rtac_jax.parameters import Scalar, parameter

_POLE = np.sqrt(3.0) - 2.0  # of the cubic spline through equidistant points: 1 / (z + 4 + 1/z)
_REACH = BEYOND  # intervals, after which it is below 1e-6
_WEIGHTS = 0.5 * np.sqrt(3.0) * (1.0 - _POLE**2) * _POLE ** np.arange(_REACH)


class InputHold(Input):
    """A behaviour of the inputs between samples other than declared, in whole or in part.

    Order 0 is a staircase, 1 straight lines, 3 the cubic spline that stands for a band-limited signal. It acts on
    current and disturbance force alike.
    """

    id: ClassVar[str] = "input_hold"
    equation: ClassVar[str] = "u + a (u_other - u)"
    source: ClassVar[str] = (
        "Pintelon and Schoukens, System Identification (2012), section 13.2; Unser (1999) for splines"
    )
    port: ClassVar[str] = "input"

    share: Scalar = parameter(
        symbol="a", unit="1", bounds=(0.0, 2.0), meaning="fraction of the other behaviour between samples", null=0.0,
        plausible=1.0,
    )  # fmt: skip
    order: Scalar = parameter(
        symbol="p", unit="1", bounds=(0.0, 3.0), meaning="its order: 0 held, 1 straight, 3 band-limited", fixed=True,
        plausible=(3.0, 1.0, 0.0),
    )  # fmt: skip

    def transform(self, coefficients: Pieces, channel: str, sample_time: Number) -> Pieces:
        values = coefficients[:, 0]
        ahead = jnp.concatenate([values[1:], values[-1:]])
        count = len(values)
        # Beyond its ends the input goes on as its mirror image about them, evenly in value and slope.
        near = np.minimum(np.arange(1, _REACH + 1), count - 1)
        before, after = 2 * values[:1] - values[near[::-1]], 2 * values[-1:] - values[count - 1 - near]
        around = jnp.concatenate([before, values, after])
        slope: Any = sum(
            weight * (around[_REACH + k : _REACH + k + count] - around[_REACH - k : _REACH - k + count])
            for k, weight in enumerate(_WEIGHTS, 1)
        )
        later = jnp.concatenate([slope[1:], slope[-1:]])
        rise, none = ahead - values, jnp.zeros_like(values)
        spline = jnp.stack([values, slope, 3.0 * rise - 2.0 * slope - later, slope + later - 2.0 * rise], axis=1)
        line = jnp.stack([values, rise, none, none], axis=1)
        held = jnp.stack([values, none, none, none], axis=1)
        other = jnp.where(self.order < 0.5, held, jnp.where(self.order < 2.0, line, spline))
        declared = jnp.pad(coefficients, ((0, 0), (0, 4 - coefficients.shape[1]), (0, 0)))
        return declared + self.share * (other - declared)


_NODES, _NODE_WEIGHTS = (
    0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(4), (1.0, 0.0), strict=True)
)

_KEPT = 2  # moments of a delayed input over an interval: what moves velocities, and what moves positions


class InputDelay(Input):
    """A transport delay of the current behind its command, a fraction of a sample or many of them.

    The delayed command has a jump or a kink within each interval. It is replaced by the straight line with the same mean
    and the same first moment over the interval, which moves arm and cart alike and is continuous in the delay: one
    Runge-Kutta step follows a line without error, and no curve of higher order. What a curved command deviates from its
    own such line goes along, from sample to sample; it has neither mean nor moment. So the result does not depend on how many
    powers an input is written with, and a delay of zero is nothing.
    Before the record the command is taken to have been what it is first.
    """

    id: ClassVar[str] = "input_delay"
    equation: ClassVar[str] = "i(t) = i_command(t - tau)"
    resembles: ClassVar[tuple[str, ...]] = ("current_lag",)
    source: ClassVar[str] = "Astrom and Wittenmark, Computer-Controlled Systems (1997), section 2.3"

    delay: Scalar = parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="transport delay of the current", null=0.0,
        plausible=lambda s: 1.5 * s.sample_time,
    )  # fmt: skip

    def remark(self, body: RigidBody) -> str:
        del body
        return "Sensors that are all late by as much, as behind filters that are alike, are the same as input_delay."

    def transform(self, coefficients: Pieces, channel: str, sample_time: Number) -> Pieces:
        return delayed(coefficients, self.delay, sample_time) if channel == "current" else coefficients

    def dead_time(self) -> Any:
        return self.delay


def delayed(coefficients: Pieces, delay: Number, sample_time: Number) -> Pieces:
    """Return an input that comes later, as `InputDelay` says."""
    count, powers = coefficients.shape[:2]
    shift = jnp.minimum(delay / sample_time, count)
    whole = jnp.floor(shift)
    part = shift - whole
    first = jnp.zeros_like(coefficients[:1]).at[:, 0].set(coefficients[:1, 0])
    rows = jnp.concatenate([first, coefficients])
    place = jnp.arange(count)[:, None] - whole.astype(int) + 1

    def shifted(of: Pieces) -> tuple[Pieces, Pieces]:
        """Return the pieces that an interval sees of the last whole sample before, and of the one before that."""
        now, late = (jnp.clip(at, 0, count)[:, None, :] for at in (place, place - 1))
        return jnp.take_along_axis(of, now, axis=0), jnp.take_along_axis(of, late, axis=0)

    now, late = shifted(rows)
    before, after = _moments(part, 0.0, 1.0 - part, powers), _moments(1.0 - part, part, 0.0, powers)
    lines = _projected(before, late) + _projected(after, now)
    if powers <= _KEPT:
        return lines
    curved = rows.at[:, :_KEPT].add(-_projected(_moments(jnp.ones_like(part), 0.0, 0.0, powers), rows))
    now, late = shifted(curved)
    return (part * late + (1.0 - part) * now).at[:, :_KEPT].add(lines)


def straightened(coefficients: Pieces) -> Pieces:
    """Return the straight line with the same mean and the same first moment in every interval."""
    powers = coefficients.shape[1]
    if powers <= _KEPT:
        return jnp.pad(coefficients, ((0, 0), (0, _KEPT - powers), (0, 0)))
    whole = jnp.ones(coefficients.shape[2])
    return _projected(_moments(whole, 0.0, 0.0, powers), coefficients)


def _projected(moments: Array, pieces: Pieces) -> Pieces:
    """Return the sum over the powers of the pieces of what each of them contributes: [interval, power, experiment]."""
    return jnp.einsum("kpe,spe->ske", moments, pieces)


def _moments(length: Array, begin: Array | float, source: Array | float, powers: int) -> Array:
    """Return the projection of a stretch of an interval on straight lines: [power of result, power of source, experiment].

    Args:
        length: of the stretch, as a fraction of the interval.
        begin: where it begins.
        source: where in its own interval the source begins there.
        powers: number of powers of the source.
    """
    total = 0.0
    legendre = [np.polynomial.Legendre.basis(k, domain=[0, 1]) for k in range(_KEPT)]
    basis: Any = np.array(
        [np.pad(p.convert(kind=np.polynomial.Polynomial).coef, (0, _KEPT - k - 1)) for k, p in enumerate(legendre)]
    )
    # Moments against the Legendre polynomials, and these, in powers of the fraction of the interval.
    project = basis.T @ np.diag(2.0 * np.arange(_KEPT) + 1.0) @ basis
    for node, weight in zip(_NODES, _NODE_WEIGHTS, strict=True):
        at, value = begin + length * node, source + length * node
        tests = jnp.stack([at**k + 0.0 * length for k in range(_KEPT)])
        values = jnp.stack([value**k + 0.0 * length for k in range(powers)])
        total = total + length * weight * tests[:, None] * values[None]
    return jnp.tensordot(project, total, axes=1)
