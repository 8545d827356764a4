"""A first-order lag over one step, exact however short its time constant is."""

from typing import Any

import jax.numpy as jnp

from rtac_jax._numbers import Number


def decay(ratio: Number) -> Any:
    """Return exp(-1 / ratio) for a time constant in units of the step; 0, with derivative 0, where there is no lag."""
    return jnp.exp(-1.0 / jnp.maximum(ratio, 1e-3))


def behind(by: Number, ratio: Number, change: Number, bend: Number = 0.0) -> Any:
    """Return the lead of a lag's output over its input after a step, for an input that is straight or a parabola.

    Args:
        by: lead of the output over the input before the step.
        ratio: time constant in units of the step.
        change: of the input in the step.
        bend: half the change of its slope in the step, per step.
    """
    left = decay(ratio)
    even = by * left - ratio * change * (1.0 - left)
    return even + bend * ratio * ((2.0 * ratio - 1.0) - (2.0 * ratio + 1.0) * left)


def averaged(by: Number, ratio: Number, change: Number, elapsed: Number) -> Any:
    """Return the lead within the step, as the straight line over the step with the same mean and the same first moment.

    A lag that is much shorter than the step would be missed, or taken for longer than it is, by the few instants at
    which a Runge-Kutta step looks; what it does to velocity and position in the step is in these two moments. The
    arguments are those of `behind`.
    """
    left = decay(ratio)
    mean = ratio * (1.0 - left)
    slope = 12.0 * ratio * (mean - left) - 6.0 * mean
    fraction = mean + slope * (elapsed - 0.5)
    return by * fraction - ratio * change * (1.0 - fraction)
