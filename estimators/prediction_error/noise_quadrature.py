"""Derivatives of a Kalman filter's likelihood by its noise, carried along beside the filter."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class ByNoise(NamedTuple):
    """The derivatives by the logarithm of each noise: the random force and torque, then each sensor.

    Attributes:
        state: of the predicted state.
        spread: of its covariance.
        slope: of the negative log-likelihood of the samples so far.
        information: its expected curvature (Fisher).
    """

    state: Float[Array, "noise state experiment"]
    spread: Float[Array, "noise state state experiment"]
    slope: Float[Array, "noise experiment"]
    information: Float[Array, "noise noise experiment"]

    @classmethod
    def at_start(cls, own: Float[Array, "noise state experiment"]) -> "ByNoise":
        """Return the derivatives at a start whose variance is in proportion to the noise as far as `own` says."""
        count, states, experiments = own.shape
        return cls(
            jnp.zeros((count, states, experiments)),
            own[:, :, None] * jnp.eye(states)[:, :, None],
            jnp.zeros((count, experiments)),
            jnp.zeros((count, count, experiments)),
        )

    def onward(
        self,
        shown: Float[Array, "output state experiment"],
        whitener: Float[Array, "output output experiment"],
        white: Float[Array, "output experiment"],
        gain: Float[Array, "state output experiment"],
        variance: Float[Array, "output experiment"],
        counts: Float[Array, " experiment"],
        transition: Float[Array, "state state experiment"],
        pushed: Float[Array, "process state state experiment"],
        fresh: Float[Array, "noise state experiment"],
    ) -> "ByNoise":
        """Return the derivatives one sample later.

        The linearised model is taken as it is: its own change with the noise would cost far more and matters far less.

        Args:
            shown: derivatives of the outputs by the state; zero where nothing is measured.
            whitener: triangular; times the prediction error it is `white`.
            white: whitened prediction error of the sample.
            gain: of the filter.
            variance: of each sensor.
            counts: 1 where the sample's likelihood counts, else 0.
            transition: derivatives of the next state by this one.
            pushed: what the random force and the random torque add to the covariance until the next sample.
            fresh: what else each noise adds, on the diagonal.

        Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19 (1974), equations of the sensitivities; the
        covariance's are shorter, as the gain is the best and its own change has no effect.
        """
        outputs, states = shown.shape[:2]
        process = pushed.shape[0]
        sensors = jnp.concatenate([jnp.zeros((process, outputs)), jnp.eye(outputs)])[:, :, None] * variance
        error = -_times(shown, self.state)
        reach = jnp.sum(self.spread[:, :, None] * shown[None, None], axis=3)  # [noise state output experiment]
        doubt = jnp.sum(shown[None, :, :, None] * reach[:, None], axis=2)
        doubt = doubt + jnp.eye(outputs)[:, :, None] * sensors[:, :, None]
        doubt = jnp.sum(whitener[None, :, :, None] * doubt[:, None], axis=2)
        doubt = jnp.sum(doubt[:, :, None] * whitener[None, None], axis=3)  # in units of the standard deviation
        error = _times(whitener, error)
        trace = sum(doubt[:, j, j] for j in range(outputs))
        slope = jnp.sum(error * white, axis=1) - 0.5 * jnp.sum(
            jnp.sum(doubt * white[None, None], axis=2) * white, axis=1
        )
        slope = slope + 0.5 * trace
        curvature = jnp.sum(error[:, None] * error[None], axis=2) + 0.5 * jnp.sum(
            doubt[:, None] * doubt[None], axis=(2, 3)
        )
        # The change of the gain times the error, from the whitened error.
        pull = jnp.sum(whitener * white[:, None], axis=0)
        state = self.state + jnp.sum(reach * pull[None, None], axis=2)
        state = state - _times(gain, _times(shown, state) + sensors * pull)
        kept = jnp.eye(states)[:, :, None] - jnp.sum(gain[:, :, None] * shown[None], axis=1)
        kept = jnp.sum(transition[:, :, None] * kept[None], axis=1)
        carried = jnp.sum(
            transition[:, :, None] * gain[None], axis=1
        )  # of the sensors' noise, [state output experiment]
        spread = jnp.sum(kept[None, :, :, None] * self.spread[:, None], axis=2)
        spread = jnp.sum(spread[:, :, None] * kept[None, None], axis=3)
        struck = jnp.moveaxis(carried[:, None] * carried[None] * variance, 2, 0)
        spread = spread + jnp.concatenate([pushed, struck]) + jnp.eye(states)[:, :, None] * fresh[:, :, None]
        return ByNoise(
            _times(transition, state), spread, self.slope + counts * slope, self.information + counts * curvature
        )


def _times(
    matrix: Float[Array, "row column experiment"], vectors: Float[Array, "noise column experiment"]
) -> Float[Array, "noise row experiment"]:
    return jnp.sum(matrix[None] * vectors[:, None], axis=2)
