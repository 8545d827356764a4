"""Trajectories of closed loops and the metrics by which they are judged."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

Rows = Float[np.ndarray, "sample plant"]
Plants = Float[np.ndarray, " plant"]


@dataclasses.dataclass(frozen=True)
class ClosedLoop:
    """Responses of one or many plants; arrays have one column per plant.

    Attributes:
        time: [s].
        cart_position: [m].
        arm_angle: [rad].
        arm_velocity: [rad/s].
        torque: of the motor, as commanded [N m].
        torque_limit: [N m].
    """

    time: Float[np.ndarray, " sample"]
    cart_position: Rows
    arm_angle: Rows
    arm_velocity: Rows
    torque: Rows
    torque_limit: float

    def settling_time(self, fraction: float = 0.1) -> Plants:
        """Return the time from when on |q| stays under this fraction of its first value [s]; infinite if it never does.

        It stays there if the response goes on for the longest half swing until then: at its end a cart that swings farther may just
        pass through zero.

        Raises:
            ValueError: the fraction is not between 0 and 1, or a cart starts at zero.
        """
        if not 0 < fraction < 1:
            raise ValueError(f"fraction is {fraction}, but must lie between 0 and 1.")
        first = np.abs(self.cart_position[0])
        if not np.all(first > 0):
            raise ValueError("settling needs a displacement at the start; this response starts at zero.")
        above = ~(np.abs(self.cart_position) <= fraction * first)  # so that what is not a number counts as above
        last = len(self.time) - 1 - np.argmax(above[::-1], axis=0)
        after = np.minimum(last + 1, len(self.time) - 1)
        settled = np.where(np.any(above, axis=0), self.time[after], 0.0)
        followed = self.time[-1] - settled >= self._longest_half_swing(settled)
        return np.where(above[-1] | ~followed, np.inf, settled)

    def _longest_half_swing(self, until: Plants) -> Plants:
        """Return the longest time from the start, or a passage of the cart through zero, to its next passage until then [s].

        What creeps within the band later is no swing.
        """
        passes = np.diff(np.signbit(self.cart_position), axis=0)
        found = np.zeros(passes.shape[1])
        for plant, one in enumerate(passes.T):
            passed = self.time[1:][one]
            found[plant] = np.max(np.diff(passed[passed <= until[plant]], prepend=self.time[0]), initial=0.0)
        return found

    @property
    def effort(self) -> Plants:
        """Rms of the torque [N m]."""
        return np.sqrt(np.mean(self.torque**2, axis=0))

    @property
    def peak_torque(self) -> Plants:
        """Largest torque [N m]."""
        return np.max(np.abs(self.torque), axis=0)

    @property
    def saturated(self) -> Plants:
        """Fraction of the time at the torque limit, between 0 and 1."""
        return np.mean(np.abs(self.torque) >= self.torque_limit * (1 - 1e-9), axis=0)

    @property
    def arm_swing(self) -> Plants:
        """Largest distance of the arm from where it started [rad]."""
        return np.max(np.abs(self.arm_angle - self.arm_angle[0]), axis=0)

    @property
    def wound_up(self) -> Bool[np.ndarray, " plant"]:
        """Return whether the arm left its half of the circle, |theta - theta_0| > pi/2, beyond which its push turns round."""
        return ~(self.arm_swing <= 0.5 * np.pi)

    def holds(self, *, within: float = 3.0, fraction: float = 0.1) -> Bool[np.ndarray, " plant"]:
        """Return whether each plant settles in this time [s] without winding up its arm; the torque is limited anyway."""
        return (self.settling_time(fraction) <= within) & ~self.wound_up
