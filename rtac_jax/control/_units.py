"""Conversion between SI units and the units of a controller's design, and of its output into torque."""

import dataclasses

import control as ct
import numpy as np

from rtac_jax._rtac import RTAC
from rtac_jax.linearisation import linearise

# Found with the rules of `propose_weights`, by a search over closed loops of plants about Table 1(c).
_SWING = 0.9  # rad
_ARM_FREQUENCY = 1 / 3  # of the arm on its electric spring, over that of the cart


@dataclasses.dataclass(frozen=True)
class Units:
    """The units in which a linear plant counts cart position and motor torque; its time is always in seconds.

    Attributes:
        position: of the plant's output in one metre.
        torque: of the plant's input in one newton metre.

    Raises:
        ValueError: a factor is not positive and finite.
    """

    position: float
    torque: float

    def __post_init__(self) -> None:
        for name in ("position", "torque"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"Units: {name} is {value}, but must be positive and finite.")

    @classmethod
    def si(cls) -> "Units":
        """Return metres and newton metres."""
        return cls(1.0, 1.0)

    @classmethod
    def nondimensional(cls, model: RTAC) -> "Units":
        """Return the units of equation (3)'s scaling.

        They are those of xi = sqrt((M+m)/(I+me^2)) q and u = (M+m)/(k (I+me^2)) N; paper, reference [2]. At small
        coupling theta'' = w_0^2 u, so that at the natural frequency w_0 an amplitude u swings the arm by as many
        radians.

        Raises:
            ValueError: the model is a batch of plants, or has no spring.
        """
        names = ("total_mass", "arm_inertia", "spring_stiffness")
        if any(np.ndim(model[name]) for name in names):
            raise ValueError(
                "the plants of a batch differ in their scales; give the units for which the controller was made."
            )
        mass, inertia, stiffness = (float(model[name]) for name in names)
        if not stiffness > 0:
            raise ValueError(
                "the model has no spring (spring_stiffness = 0), so equation (3) has no scale of torque; give units."
            )
        return cls(float(np.sqrt(mass / inertia)), mass / (stiffness * inertia))

    def __str__(self) -> str:
        return f"1 m = {self.position:.6g}, 1 N m = {self.torque:.6g} of the plant's units, time in seconds"


@dataclasses.dataclass(frozen=True)
class Actuation:
    """The conversion of the controller's output into the motor's torque: torque = clip(u / cos(theta)) - stiffness theta.

    The division is that of Fig. 3 of the paper. The rest keeps the arm within its half of the circle, beyond which its push
    on the cart turns round: a limit on the controller's part limits the swing, and a weak electric spring brings the
    arm back to where it started, which nothing else on a level rig does.

    Attributes:
        controller_limit: on u / cos(theta) [N m].
        motor_limit: on the whole torque [N m].
        dead_band: |cos(theta)| up to which there is no torque at all.
        arm_stiffness: of the electric spring [N m/rad]; 0 as in the paper.

    Raises:
        ValueError: a limit is not positive, or another number is negative or not finite.
    """

    controller_limit: float = 0.1
    motor_limit: float = 0.1
    dead_band: float = 0.05
    arm_stiffness: float = 0.0

    def __post_init__(self) -> None:
        for name in ("controller_limit", "motor_limit", "dead_band", "arm_stiffness"):
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0 or (value == 0 and name.endswith("limit")):
                kind = "positive" if name.endswith("limit") else "zero or positive"
                raise ValueError(f"Actuation: {name} is {value}, but must be {kind} and finite.")

    @classmethod
    def proposed(cls, model: RTAC, *, motor_limit: float = 0.1, arm_swing: float = _SWING) -> "Actuation":
        """Propose the actuation for a rig with these parameters.

        A square wave of torque at the cart's natural frequency w_0 swings the arm by 4 N / (pi J w_0^2); the
        controller's limit is the N that swings it by `arm_swing` [rad]. The electric spring puts the arm at a third of
        w_0: well below, so that the plant near w_0 stays what it is, and fast enough to undo within the settling time
        what asymmetric friction makes of the swing.

        Raises:
            ValueError: `arm_swing` does not lie between 0 and pi/2.
        """
        if not (np.isfinite(arm_swing) and 0 < arm_swing < 0.5 * np.pi):
            raise ValueError(f"arm_swing is {arm_swing}, but must lie between 0 and pi/2 rad.")
        per_radian = 1.0 / Units.nondimensional(model).torque
        return cls(
            controller_limit=min(motor_limit, 0.25 * np.pi * arm_swing * per_radian),
            motor_limit=motor_limit,
            arm_stiffness=_ARM_FREQUENCY**2 * per_radian,
        )


def nominal_plant(model: RTAC, *, units: Units | None = None, actuation: Actuation | None = None) -> ct.StateSpace:
    """Linearise the model about theta = 0, from the controller's torque to the cart's position, with as few states as it takes.

    About another angle the plant has cos(theta) as a factor, which the controller divides out. An arm that nothing
    pulls back has a neutral angle that the cart does not show; it is left out.

    Args:
        model: to be linearised.
        units: of the result; by default the nondimensional ones of the model.
        actuation: with the electric spring that acts on the arm; by default none.

    Raises:
        ValueError: as `linearise`.
    """
    chosen = units if units is not None else Units.nondimensional(model)
    whole = linearise(model)
    a, b, c = np.array(whole.A), np.array(whole.B)[:, :1], np.array(whole.C)
    if actuation is not None:
        a = a - actuation.arm_stiffness * b @ c[2:3]
    c = c[:1]
    neutral = np.max(np.abs(a[:, 2])) < 1e-12 * np.max(np.abs(a)) and c[0, 2] == 0
    kept = [i for i in range(len(a)) if not (neutral and i == 2)]
    return ct.StateSpace(
        a[np.ix_(kept, kept)], b[kept] / chosen.torque, chosen.position * c[:, kept], 0.0,
        inputs=["torque"], outputs=["cart_position"], name="nominal",
    )  # fmt: skip
