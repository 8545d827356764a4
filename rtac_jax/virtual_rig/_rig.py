"""The virtual rig, hidden effects included: plain numbers in SI units."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2], for a plane that is not level."""


DRAWN = (
    "total_mass",
    "spring_stiffness",
    "cart_viscous",
    "cart_coulomb",
    "eccentric_moment",
    "arm_inertia",
    "torque_constant",
    "arm_viscous_positive",
    "arm_viscous_negative",
)
"""The parameters of the paper's model, in the order in which `Rig.drawn` draws them."""

_POSITIVE = (
    "total_mass",
    "spring_stiffness",
    "arm_inertia",
    "cart_stribeck_velocity",
    "arm_stribeck_velocity",
    "cart_presliding_yield",
    "arm_presliding_yield",
    "hysteresis_yield",
    "flexible_frequency",
    "detent_width",
    "friction_reference",
    "maxwell_damping",
    "saturation",
    "force_saturation",
    "end_stop_travel",
    "lvdt_gain",
    "tacho_gain",
    "encoder_gain",
    "lvdt_ripple_pitch",
    "eddy_velocity",
    "shaft_stiffness",
    "noise_factor",
    "position_range",
    "velocity_range",
)
_NOT_NEGATIVE = (
    "cart_viscous",
    "cart_coulomb",
    "arm_viscous_positive",
    "arm_viscous_negative",
    "arm_coulomb",
    "cart_quadratic_drag",
    "arm_quadratic_drag",
    "cart_stribeck",
    "arm_stribeck",
    "arm_load_friction",
    "hysteresis_stiffness",
    "cable_stiffness",
    "torque_droop",
    "force_droop",
    "eddy_torque",
    "cart_presliding",
    "arm_presliding",
    "flexible_mass",
    "flexible_damping",
    "maxwell_stiffness",
    "end_stop_stiffness",
    "current_lag",
    "input_delay",
    "dead_zone",
    "force_delay",
    "force_lag",
    "force_dead_zone",
    "backlash",
    "shaft_damping",
    "tacho_lag",
    "tacho_delay",
    "lvdt_lag",
    "channel_delay",
    "encoder_lag",
    "force_noise",
    "torque_noise",
    "position_noise",
    "velocity_noise",
    "angle_noise",
)


@dataclass(frozen=True)
class Rig:
    """The true rig: equations (1)-(2) with the friction of section 4, hidden effects, and its sensors.

    The defaults of the first nine fields are Table 1 of the paper; every hidden effect is absent by default.
    The cart obeys

        (M+m) q'' + me cos(theta) theta'' = -k q + me theta'^2 sin(theta) - v q' - d sgn(q') + F + ...
        J theta'' + me cos(theta) q''     = K_m i - K_v theta' + ...

    where sgn is set-valued: a cart that stands still is held by any force up to d.

    Raises:
        ValueError: a number is not finite where it must be, or has an impossible sign; the message names it.
    """

    total_mass: float = 1.23
    """M + m [kg]."""
    spring_stiffness: float = 132.6
    """k [N/m]."""
    cart_viscous: float = 0.5543
    """v = b + c [N s/m]."""
    cart_coulomb: float = 0.024
    """d [N]."""
    eccentric_moment: float = 1.06e-3
    """me [kg m]."""
    arm_inertia: float = 9.5e-5
    """J = I + me^2 [kg m^2]."""
    torque_constant: float = 0.0804
    """K_m [N m/A]."""
    arm_viscous_positive: float = 1.39e-4
    """K_v1 [N m s/rad], for theta' > 0."""
    arm_viscous_negative: float = 1.49e-4
    """K_v2 [N m s/rad], for theta' < 0."""

    cubic_spring: float = 0.0
    """k3 [N/m^3]: force -k3 q^3."""
    quadratic_spring: float = 0.0
    """k2 [N/m^2]: force -k2 q^2."""
    force_offset: float = 0.0
    """[N]: a constant force."""
    hysteresis_stiffness: float = 0.0
    """kh [N/m]: force -kh z with Bouc-Wen's z' = q' - (|q'| z + q' |z|) / (2 z_y)."""
    hysteresis_yield: float = 1e-3
    """z_y [m]."""
    flexible_mass: float = 0.0
    """Part of the total mass [kg] that sits on the cart through a spring and a damper of its own."""
    flexible_frequency: float = 37.4
    """Natural frequency [rad/s] of that part on a cart held fast."""
    flexible_damping: float = 0.02
    """Its damping ratio [1]."""
    cart_quadratic_drag: float = 0.0
    """c [N s^2/m^2]: force -c |q'| q'."""
    cart_asymmetry: float = 0.0
    """a [N s/m]: force -a |q'|."""
    cart_stribeck: float = 0.0
    """f [N]: the friction bound grows by f exp(-(q'/v_s)^2)."""
    cart_stribeck_velocity: float = 0.005
    """v_s [m/s]."""
    cart_presliding: float = 0.0
    """f [N]: friction by bristles, force -f z / z_y with Dahl's z' = q' - |q'| z / z_y."""
    cart_presliding_yield: float = 5e-5
    """z_y [m]."""
    end_stop_travel: float = math.inf
    """Travel [m] to each side before the stop is touched."""
    end_stop_stiffness: float = 2e4
    """Stiffness of the stop [N/m]."""
    arm_coulomb: float = 0.0
    """tau_c [N m], set-valued like d."""
    arm_stribeck: float = 0.0
    """[N m]: the arm's friction bound grows by this times exp(-(theta'/w_s)^2)."""
    arm_stribeck_velocity: float = 0.5
    """w_s [rad/s]."""
    arm_presliding: float = 0.0
    """tau [N m]: the same for the arm."""
    arm_presliding_yield: float = 0.02
    """z_y [rad]."""
    arm_load_friction: float = 0.0
    """mu [1]: the arm's friction bound grows by this times the torque of the motor."""
    arm_quadratic_drag: float = 0.0
    """[N m s^2/rad^2]: torque -c |theta'| theta'."""
    tilt_along: float = 0.0
    """beta [rad]: in-plane gravity g sin(beta) along +q."""
    tilt_across: float = 0.0
    """[rad]: in-plane gravity across the travel, towards the arm's position at theta = 0."""
    cogging_torque: float = 0.0
    """A [N m]: torque A sin(n theta + phi)."""
    cogging_order: float = 4.0
    """n [1]."""
    cogging_phase: float = 0.0
    """phi [rad]."""
    second_cogging_torque: float = 0.0
    """A [N m]: another torque A sin(n theta + phi)."""
    second_cogging_order: float = 8.0
    """n [1]."""
    second_cogging_phase: float = 0.0
    """phi [rad]."""
    torque_ripple: float = 0.0
    """a [1]: the motor's torque times 1 + a sin(n theta + phi)."""
    torque_ripple_order: float = 6.0
    """n [1]."""
    torque_ripple_phase: float = 0.0
    """phi [rad]."""
    cable_stiffness: float = 0.0
    """k_c [N m/rad]: torque -k_c (theta - theta_home)."""
    cable_home: float = 0.0
    """theta_home [rad]."""

    backlash: float = 0.0
    """Gap [rad] within which rotor and arm turn freely against each other; they start in its middle."""
    shaft_stiffness: float = math.inf
    """Stiffness [N m/rad] of the shaft between rotor and arm; in a gap's contact it acts too, and is large if infinite."""
    shaft_damping: float = 0.0
    """Damping [N m s/rad] of the twist; a contact without a stiffness of its own has enough not to bounce."""
    rotor_share: float = 0.3
    """Fraction [1] of J that is the rotor's, where rotor and arm are apart; motor, tachometer and encoder sit on the rotor."""

    saturation: float = math.inf
    """Limit of the commanded current [A]."""
    input_delay: float = 0.0
    """Transport delay of the current [s]."""
    current_lag: float = 0.0
    """Time constant of the current [s]."""
    current_offset: float = 0.0
    """Added to the current [A]."""
    dead_zone: float = 0.0
    """delta [A]: no torque below it, and i - delta sgn(i) beyond."""
    force_delay: float = 0.0
    """Transport delay of the disturbance force [s]; before the beginning it was what it is there."""
    force_lag: float = 0.0
    """Time constant of the disturbance force [s]; it begins in equilibrium."""
    force_saturation: float = math.inf
    """Limit of what is left of the disturbance force then [N]."""
    force_dead_zone: float = 0.0
    """delta [N]: no force below it, and F - delta sgn(F) beyond."""
    force_droop: float = 0.0
    """[1/N]: what is left then falls by the factor 1 / (1 + droop |F|)."""
    torque_droop: float = 0.0
    """[1/A]: the torque constant falls by the factor 1 / (1 + droop |i|)."""

    tacho_bias: float = 0.0
    """[rad/s]."""
    tacho_gain: float = 1.0
    """[1]."""
    tacho_lag: float = 0.0
    """Time constant [s]."""
    tacho_delay: float = 0.0
    """The tachometer is sampled later than the other channels by this [s]."""
    lvdt_cubic: float = 0.0
    """c [1/m^2]: the LVDT shows q + c q^3."""
    lvdt_lag: float = 0.0
    """Time constant [s]."""
    lvdt_gain: float = 1.0
    """[1]."""
    lvdt_offset: float = 0.0
    """[m]."""
    lvdt_ripple: float = 0.0
    """A [m]: the LVDT shows A sin(2 pi q / pitch + phase) more."""
    lvdt_ripple_pitch: float = 2e-3
    """[m]."""
    lvdt_ripple_phase: float = 0.0
    """[rad]."""
    channel_delay: float = 0.0
    """The LVDT is sampled later than the other channels by this [s]."""
    tacho_ripple: float = 0.0
    """A [1]: the tachometer shows 1 + A sin(n theta + phase) times the velocity."""
    tacho_ripple_order: float = 1.0
    """n [1]."""
    tacho_ripple_phase: float = 0.0
    """[rad]."""
    encoder_gain: float = 1.0
    """[1]."""
    encoder_offset: float = 0.0
    """[rad]."""
    encoder_ripple: float = 0.0
    """A [rad]: the encoder shows A sin(n theta + phase) more."""
    encoder_ripple_order: float = 1.0
    """n [1]."""
    encoder_ripple_phase: float = 0.0
    """[rad]."""
    encoder_lag: float = 0.0
    """Time constant [s]."""

    force_noise: float = 0.0
    """White random force on the cart [N/sqrt(Hz)]: its square is the two-sided spectral density."""
    torque_noise: float = 0.0
    """White random torque on the arm [N m/sqrt(Hz)]."""
    friction_slope: float = 0.0
    """a [1], outside the catalogue: the cart's Coulomb friction is d (1 + a q / q_ref), not below zero."""
    friction_reference: float = 0.01
    """q_ref [m]."""
    detent_force: float = 0.0
    """A [N], outside the catalogue: force -A (x/s) exp((1 - (x/s)^2)/2) with x = q - q_0; A is its peak."""
    detent_position: float = 0.003
    """q_0 [m]."""
    detent_width: float = 1e-3
    """s [m]."""
    vibration_force: float = 0.0
    """A [N], outside the catalogue: force A sin(2 pi f t + phase) from the floor."""
    vibration_frequency: float = 7.0
    """f [Hz]."""
    vibration_phase: float = 0.0
    """[rad]."""
    maxwell_stiffness: float = 0.0
    """[N/m], outside the catalogue: a spring in series with a damper, both in parallel with k."""
    maxwell_damping: float = 10.0
    """[N s/m]."""
    one_sided_spring: float = 0.0
    """k_1 [N/m], outside the catalogue: force -k_1 max(q, 0), a spring that is stiffer on one side."""
    eddy_torque: float = 0.0
    """T [N m], outside the catalogue: an eddy-current brake, -2 T x / (1 + x^2) with x = theta' / w_c; T is its peak."""
    eddy_velocity: float = 5.0
    """w_c [rad/s]."""

    position_noise: float = 2e-5
    """Standard deviation of the LVDT [m]."""
    velocity_noise: float = 0.05
    """Standard deviation of the tachometer [rad/s]."""
    angle_noise: float = 1e-3
    """Standard deviation of the encoder [rad]."""
    noise_correlation: float = 0.0
    """Correlation [1] of the noise of neighbouring samples: 0 is white, else AR(1) of the same variance."""
    noise_factor: float = 1.0
    """The sensors are noisier than stated above, and than `record` writes, by this factor [1]."""
    encoder: bool = False
    """Whether the arm angle is measured."""
    quantisation_bits: int | None = 12
    """Bits of the converter behind LVDT and tachometer, or None for no quantisation and no range."""
    position_range: float = 0.02
    """The converter's range is plus and minus this [m]."""
    velocity_range: float = 60.0
    """The converter's range is plus and minus this [rad/s]."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            if entry.name in ("encoder", "quantisation_bits"):
                continue
            value = getattr(self, entry.name)
            infinite = (
                entry.name in ("saturation", "force_saturation", "end_stop_travel", "shaft_stiffness")
                and value == math.inf
            )
            if not (math.isfinite(value) or infinite):
                raise ValueError(f"Rig.{entry.name} is {value!r}; it must be finite.")
        for name in _POSITIVE:
            if getattr(self, name) <= 0:
                raise ValueError(f"Rig.{name} is {getattr(self, name)!r}; it must be greater than zero.")
        for name in _NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise ValueError(f"Rig.{name} is {getattr(self, name)!r}; it must not be negative.")
        if not abs(self.noise_correlation) < 1:
            raise ValueError("Rig.noise_correlation must lie between -1 and 1.")
        if self.quantisation_bits is not None and not 2 <= self.quantisation_bits <= 32:
            raise ValueError("Rig.quantisation_bits must lie between 2 and 32, or be None.")
        if not 0 < self.rotor_share < 1:
            raise ValueError("Rig.rotor_share must lie between 0 and 1.")
        if self.eccentric_moment**2 >= self.lone_arm_inertia * (self.total_mass - self.flexible_mass):
            raise ValueError(
                "Rig.eccentric_moment is too large: its square must be below J times the mass of the cart."
            )

    @property
    def apart(self) -> bool:
        """Return whether rotor and arm turn against each other."""
        return self.backlash > 0 or math.isfinite(self.shaft_stiffness)

    @property
    def drives_late(self) -> bool:
        """Return whether current or force come later than they are asked for."""
        return any(x > 0 for x in (self.input_delay, self.current_lag, self.force_delay, self.force_lag))

    @property
    def lone_arm_inertia(self) -> float:
        """Inertia of the arm [kg m^2], with the rotor where they are one."""
        return self.arm_inertia * (1 - self.rotor_share if self.apart else 1)

    def drawn(self, seed: int, spread: float = 0.15) -> "Rig":
        """Return a rig whose nine parameters of the paper's model lie uniformly within a fraction of these.

        Args:
            seed: the draw depends on it alone.
            spread: largest relative deviation [1], at least 0 and below 1.

        Raises:
            ValueError: the spread is outside its range.
        """
        if not 0 <= spread < 1:
            raise ValueError(f"spread is {spread!r}; it must be at least 0 and below 1.")
        factors = np.random.default_rng(seed).uniform(1 - spread, 1 + spread, len(DRAWN))
        values: dict[str, Any] = {
            name: getattr(self, name) * float(factor) for name, factor in zip(DRAWN, factors, strict=True)
        }
        return replace(self, **values)
