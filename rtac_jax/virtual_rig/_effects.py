"""Hidden effects: each adds impulses to a batch of trajectories, or changes what holds it back.

A builder looks at the rigs of the batch and returns a function to be called in each step, or None when no rig
has the effect. Trajectories of one rig are neighbours, so an effect works on a slice of the batch.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ._rig import GRAVITY, Rig

Act = Callable[[], None]


class Batch:
    """The state of a batch that effects read and write; B is the number of trajectories, row 0 the cart, row 1 the arm."""

    def __init__(self, rigs: Sequence[Rig], start: np.ndarray, speed: np.ndarray, step: float) -> None:
        self.rigs = rigs
        self.step = step
        self.position = start
        """(2, B) cart position and arm angle; in the middle of a step while effects act."""
        self.velocity = speed
        """(2, B) at the beginning of the step."""
        self.predicted = speed.copy()
        """(2, B) velocity extrapolated to the middle of the step."""
        self.impulse = np.zeros_like(start)
        """(2, B) impulses [N s] and [N m s] of this step, to be added to."""
        self.limit = np.zeros_like(start)
        """(2, B) largest friction impulse."""
        self.time = 0.0
        """Middle of the step [s]."""
        self.motor = np.zeros(start.shape[1])
        """(B,) impulse of the motor in this step [N m s], part of `impulse`."""
        self.rotor = start[1].copy(), speed[1].copy()
        """(B,) angle of the rotor, in the middle of a step while effects act, and its speed at the beginning."""

    def column(self, name: str) -> np.ndarray:
        """Return a parameter of every rig, (B,)."""
        return np.array([getattr(rig, name) for rig in self.rigs], dtype=float)

    def rows(self, name: str, null: float = 0.0) -> slice | None:
        """Return the slice of the batch that holds every trajectory with this effect, or None."""
        there = np.flatnonzero(self.column(name) != null)
        return slice(int(there[0]), int(there[-1]) + 1) if there.size else None


def springs(batch: Batch) -> Act | None:
    """Build the cubic and the quadratic spring of the cart."""
    cubic, quadratic = batch.rows("cubic_spring"), batch.rows("quadratic_spring")
    if cubic is None and quadratic is None:
        return None
    k3, k2 = batch.column("cubic_spring") * batch.step, batch.column("quadratic_spring") * batch.step
    position, impulse = batch.position[0], batch.impulse[0]

    def act() -> None:
        impulse[:] -= (k3 * position + k2) * (position * position)

    return act


def one_sided_spring(batch: Batch) -> Act | None:
    """Build the spring that acts on one side of the cart's rest only."""
    if batch.rows("one_sided_spring") is None:
        return None
    stiffness, position, impulse = batch.column("one_sided_spring") * batch.step, batch.position[0], batch.impulse[0]

    def act() -> None:
        impulse[:] -= stiffness * np.maximum(position, 0.0)

    return act


def offset(batch: Batch) -> Act | None:
    """Build the constant force on the cart."""
    if batch.rows("force_offset") is None:
        return None
    push, impulse = batch.column("force_offset") * batch.step, batch.impulse[0]

    def act() -> None:
        impulse[:] += push

    return act


def hysteresis(batch: Batch) -> Act | None:
    """Build the Bouc-Wen spring of the cart, integrated by the midpoint rule."""
    rows = batch.rows("hysteresis_stiffness")
    if rows is None:
        return None
    stiffness = batch.column("hysteresis_stiffness")[rows] * batch.step
    rate = batch.step / (2 * batch.column("hysteresis_yield")[rows])
    speed, impulse, step = batch.predicted[0, rows], batch.impulse[0, rows], batch.step
    inner = np.zeros_like(rate)

    def act() -> None:
        middle = inner + 0.5 * step * speed - 0.5 * rate * (abs(speed) * inner + speed * abs(inner))
        inner[:] += step * speed - rate * (abs(speed) * middle + speed * abs(middle))
        impulse[:] -= stiffness * middle

    return act


def bristles(batch: Batch) -> Act | None:
    """Build the friction of cart and arm by bristles, which bend over half a step before they push."""
    if batch.rows("cart_presliding") is None and batch.rows("arm_presliding") is None:
        return None
    width = np.stack([batch.column("cart_presliding_yield"), batch.column("arm_presliding_yield")])
    push = batch.step * np.stack([batch.column("cart_presliding"), batch.column("arm_presliding")])
    inner, half = np.zeros_like(width), 0.5 * batch.step

    def act() -> None:
        way = np.sign(batch.predicted)
        keep = np.exp(-half * abs(batch.predicted) / width)
        middle = way + (inner - way) * keep
        inner[:] = way + (middle - way) * keep
        batch.impulse[:] -= push * middle

    return act


def flexible_mode(batch: Batch) -> Act | None:
    """Build a second body, in absolute coordinates: what accelerates it is taken from the cart."""
    rows = batch.rows("flexible_mass")
    if rows is None:
        return None
    step, mass = batch.step, batch.column("flexible_mass")[rows]
    frequency, ratio = batch.column("flexible_frequency")[rows], batch.column("flexible_damping")[rows]
    stiff, damp = step * frequency**2, step * ratio * frequency
    cart, cart_speed, impulse = batch.position[0, rows], batch.predicted[0, rows], batch.impulse[0, rows]
    speed = batch.velocity[0, rows].copy()
    place = cart + 0.5 * step * speed

    def act() -> None:
        kick = (stiff * (cart - place) + 2 * damp * (cart_speed - speed)) / (1 + damp)
        speed[:] += kick
        place[:] += step * speed
        impulse[:] -= mass * kick

    return act


def quadratic_drag(batch: Batch) -> Act | None:
    """Build the quadratic drag of cart and arm."""
    if batch.rows("cart_quadratic_drag") is None and batch.rows("arm_quadratic_drag") is None:
        return None
    drag = batch.step * np.stack([batch.column("cart_quadratic_drag"), batch.column("arm_quadratic_drag")])

    def act() -> None:
        batch.impulse[:] -= drag * abs(batch.predicted) * batch.predicted

    return act


def asymmetry(batch: Batch) -> Act | None:
    """Build the viscous friction of the cart by which one way differs from the other."""
    if batch.rows("cart_asymmetry") is None:
        return None
    drag = batch.step * batch.column("cart_asymmetry")

    def act() -> None:
        batch.impulse[0] -= drag * abs(batch.predicted[0])

    return act


def end_stop(batch: Batch) -> Act | None:
    """Build the elastic stops at both ends of the travel."""
    rows = batch.rows("end_stop_travel", null=np.inf)
    if rows is None:
        return None
    travel, stiffness = (
        batch.column("end_stop_travel")[rows],
        batch.column("end_stop_stiffness")[rows] * batch.step,
    )
    position, impulse = batch.position[0, rows], batch.impulse[0, rows]

    def act() -> None:
        impulse[:] -= stiffness * (position - np.clip(position, -travel, travel))

    return act


def gravity(batch: Batch) -> Act | None:
    """Build gravity on a tilted plane, of potential -(M+m) g_x q - me g_x sin(theta) - me g_y cos(theta)."""
    along, across = batch.rows("tilt_along"), batch.rows("tilt_across")
    if along is None and across is None:
        return None
    gx = batch.step * GRAVITY * np.sin(batch.column("tilt_along"))
    gy = batch.step * GRAVITY * np.sin(batch.column("tilt_across"))
    moment = batch.column("eccentric_moment")
    cart, mgx, mgy, angle = batch.column("total_mass") * gx, moment * gx, moment * gy, batch.position[1]

    def act() -> None:
        batch.impulse[0] += cart
        batch.impulse[1] += mgx * np.cos(angle) - mgy * np.sin(angle)

    return act


def cogging(batch: Batch) -> Act | None:
    """Build the cogging torque of the motor."""
    return _repeating(batch, "cogging")


def second_cogging(batch: Batch) -> Act | None:
    """Build the cogging torque of a second order."""
    return _repeating(batch, "second_cogging")


def _repeating(batch: Batch, name: str) -> Act | None:
    """Build a torque that repeats with the arm's angle."""
    rows = batch.rows(f"{name}_torque")
    if rows is None:
        return None
    torque = batch.column(f"{name}_torque")[rows] * batch.step
    order, phase = batch.column(f"{name}_order")[rows], batch.column(f"{name}_phase")[rows]
    angle, impulse = batch.position[1, rows], batch.impulse[1, rows]

    def act() -> None:
        impulse[:] += torque * np.sin(order * angle + phase)

    return act


def torque_ripple(batch: Batch) -> Act | None:
    """Build the ripple of the motor's torque."""
    rows = batch.rows("torque_ripple")
    if rows is None:
        return None
    ripple = batch.column("torque_ripple")[rows]
    order, phase = batch.column("torque_ripple_order")[rows], batch.column("torque_ripple_phase")[rows]
    angle, motor, impulse = batch.position[1, rows], batch.motor[rows], batch.impulse[1, rows]

    def act() -> None:
        impulse[:] += motor * ripple * np.sin(order * angle + phase)

    return act


def cable_spring(batch: Batch) -> Act | None:
    """Build the spring of a cable on the arm."""
    rows = batch.rows("cable_stiffness")
    if rows is None:
        return None
    stiffness, home = batch.column("cable_stiffness")[rows] * batch.step, batch.column("cable_home")[rows]
    angle, impulse = batch.position[1, rows], batch.impulse[1, rows]

    def act() -> None:
        impulse[:] -= stiffness * (angle - home)

    return act


def shaft(batch: Batch) -> Act | None:
    """Build the rotor as a body of its own: it takes the motor's impulse and hands on what the shaft or the contact takes."""
    there = np.array([rig.apart for rig in batch.rigs])
    if not there.any():
        return None
    rows = slice(int(np.flatnonzero(there)[0]), int(np.flatnonzero(there)[-1]) + 1)
    on, step, fraction = there[rows].astype(float), batch.step, batch.column("rotor_share")[rows]
    inertia = fraction * batch.column("arm_inertia")[rows]
    half_gap, stiffness = 0.5 * batch.column("backlash")[rows], batch.column("shaft_stiffness")[rows]
    hard = ~np.isfinite(stiffness)
    # As damped as the step allows, and less stiff, so that it hardly bounces; smaller steps come nearer to a hard contact.
    relative = inertia * (1 - fraction)
    stiffness[hard] = (0.25 / step) ** 2 * relative[hard]
    damping = np.where(hard, 2.0 / step * relative, batch.column("shaft_damping")[rows])
    felt = np.where(hard, relative, inertia)  # the arm's extrapolated speed knows what a soft shaft does to the arm
    angle, speed = batch.rotor[0][rows], batch.rotor[1][rows]
    arm, arm_speed, impulse = batch.position[1, rows], batch.predicted[1, rows], batch.impulse[1, rows]
    motor = batch.motor[rows]
    angle += 0.5 * step * speed

    def act() -> None:
        twist = angle - arm
        bent = twist - np.clip(twist, -half_gap, half_gap)
        drag = np.where(bent != 0, damping, 0.0)
        # Damping acts at the mean of the relative velocity over the step, which the impulse itself changes.
        passed = step * (stiffness * bent + drag * (speed - arm_speed + 0.5 * motor / inertia))
        passed = passed / (1 + 0.5 * step * drag / felt)
        pulls = (half_gap > 0) & (passed * bent <= 0)  # a contact pushes only
        passed = np.where(pulls, 0.0, passed)
        impulse[:] += on * (passed - motor)
        speed[:] += (motor - passed) / inertia
        angle[:] += step * speed

    return act


def eddy_brake(batch: Batch) -> Act | None:
    """Build an eddy-current brake of the arm."""
    rows = batch.rows("eddy_torque")
    if rows is None:
        return None
    torque, scale = 2 * batch.step * batch.column("eddy_torque")[rows], batch.column("eddy_velocity")[rows]
    speed, impulse = batch.predicted[1, rows], batch.impulse[1, rows]

    def act() -> None:
        ratio = speed / scale
        impulse[:] -= torque * ratio / (1 + ratio * ratio)

    return act


def detent(batch: Batch) -> Act | None:
    """Build a detent of the cart."""
    rows = batch.rows("detent_force")
    if rows is None:
        return None
    force, width = batch.column("detent_force")[rows] * batch.step, batch.column("detent_width")[rows]
    centre, position, impulse = (
        batch.column("detent_position")[rows],
        batch.position[0, rows],
        batch.impulse[0, rows],
    )

    def act() -> None:
        away = (position - centre) / width
        impulse[:] -= force * away * np.exp(0.5 * (1 - away * away))

    return act


def vibration(batch: Batch) -> Act | None:
    """Build the vibration of the floor, as a force on the cart."""
    rows = batch.rows("vibration_force")
    if rows is None:
        return None
    force, phase = batch.column("vibration_force")[rows] * batch.step, batch.column("vibration_phase")[rows]
    frequency, impulse = 2 * np.pi * batch.column("vibration_frequency")[rows], batch.impulse[0, rows]

    def act() -> None:
        impulse[:] += force * np.sin(frequency * batch.time + phase)

    return act


def maxwell_spring(batch: Batch) -> Act | None:
    """Build a spring and a damper in series, between cart and ground."""
    rows = batch.rows("maxwell_stiffness")
    if rows is None:
        return None
    stiffness = batch.column("maxwell_stiffness")[rows]
    rate, kick = batch.step * stiffness / batch.column("maxwell_damping")[rows], stiffness * batch.step
    position, impulse = batch.position[0, rows], batch.impulse[0, rows]
    inner = position.copy()

    def act() -> None:
        move = rate * (position - inner) / (1 + 0.5 * rate)
        impulse[:] -= kick * (position - inner - 0.5 * move)
        inner[:] += move

    return act


BUILDERS = (
    springs,
    one_sided_spring,
    offset,
    hysteresis,
    bristles,
    flexible_mode,
    quadratic_drag,
    asymmetry,
    end_stop,
    gravity,
    cogging,
    second_cogging,
    torque_ripple,
    cable_spring,
    detent,
    vibration,
    maxwell_spring,
    eddy_brake,
    shaft,
)
