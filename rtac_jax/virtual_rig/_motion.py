"""Motion of many rigs at once, by time stepping with set-valued friction (after Moreau).

Half a drift of the positions, a kick of the velocities, half a drift. The kick is linearly implicit: damping
acts at the mean velocity, and theta'^2 is replaced by the product of the velocities before and after the
step, which makes the step symmetric in time and so second-order accurate. Dry friction is an impulse of at
most d times the step that opposes sliding; where it is large enough the velocity after the step is exactly
zero.

Source: J. J. Moreau, Numerical aspects of the sweeping process, CMAME 177 (1999).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, make_interp_spline

from rtac_jax.measurement.plan import Plan

from ._dry_friction import DRY, friction_bound
from ._effects import BUILDERS, Batch
from ._rig import Rig

_HOLD = 1e-3  # random forces are held for about this long [s]


@dataclass(frozen=True, eq=False)
class Track:
    """The true motion in one experiment, at the N sample instants; no noise. Each is (N,)."""

    position: np.ndarray
    """Cart position [m]."""
    velocity: np.ndarray
    """Cart velocity [m/s]."""
    angle: np.ndarray
    """Arm angle [rad]."""
    arm_velocity: np.ndarray
    """Arm velocity [rad/s]."""
    seen_position: np.ndarray
    """Cart position behind lag and delay of the LVDT [m]."""
    seen_arm_velocity: np.ndarray
    """Velocity of the rotor, which is the arm's where they are one, behind the lag of the tachometer [rad/s]."""
    seen_angle: np.ndarray
    """Angle of the rotor behind the lag of the encoder [rad]."""


Job = tuple[Rig, Plan, np.random.SeedSequence]


def integrate(jobs: Sequence[Job], step: float) -> list[Track]:
    """Return the motion of each job, in order; jobs of equal sample time and length are integrated together.

    Args:
        jobs: a rig, a plan, and the seed of the random forces.
        step: upper bound of the integration step [s].
    """
    tracks: dict[int, Track] = {}

    def key(index: int) -> tuple[float, int]:
        return jobs[index][1].sample_time, jobs[index][1].samples

    for index, (_, plan, _) in enumerate(jobs):
        if plan.kind == "rest":
            still = [np.full(plan.samples, value) for value in (plan.initial_position, plan.initial_angle)]
            none = np.zeros(plan.samples)
            tracks[index] = Track(still[0], none, still[1], none, still[0], none, still[1])
    moving = [index for index in range(len(jobs)) if index not in tracks]
    for _, members in groupby(sorted(moving, key=key), key=key):
        group = list(members)
        tracks.update(zip(group, _integrate([jobs[index] for index in group], step), strict=True))
    return [tracks[index] for index in range(len(jobs))]


def _motor(rig: Rig, current: np.ndarray) -> np.ndarray:
    """Return the torque of the motor [N m] for the current that flows in it [A]."""
    current = current + rig.current_offset
    current = np.sign(current) * np.maximum(abs(current) - rig.dead_zone, 0.0)
    return rig.torque_constant * current / (1 + rig.torque_droop * abs(current))


def _pushed(rig: Rig, force: np.ndarray) -> np.ndarray:
    """Return the force on the cart [N] for what its drive is asked for."""
    force = np.clip(force, -rig.force_saturation, rig.force_saturation)
    force = np.sign(force) * np.maximum(abs(force) - rig.force_dead_zone, 0.0)
    return force / (1.0 + rig.force_droop * abs(force))


def _charge(values: np.ndarray, hold: str, period: float, times: np.ndarray) -> np.ndarray:
    """Return the integral of an input from the beginning to each of the times; before the beginning it was zero."""
    knots = period * np.arange(values.size + 1)
    if hold == "zoh":
        return np.interp(times, knots, np.append(0.0, period * np.cumsum(values)))
    # The last value is held. A spline of fifth degree is nearer to a band-limited signal than one of third.
    line = make_interp_spline(knots, np.append(values, values[-1]), k=1 if hold == "foh" else 5)
    return line.antiderivative()(np.clip(times, 0.0, knots[-1]))


def _late_drives(jobs: Sequence[Job], period: float, substeps: int) -> np.ndarray:
    """Return mean force and motor torque in each step, (steps, 2, B), behind hold, transport delay, saturation and lag."""
    samples, step = jobs[0][1].samples, period / substeps
    fine = step * np.arange(samples * substeps + 1)
    mean = np.zeros((samples * substeps, 2, len(jobs)))
    for b, (rig, plan, _) in enumerate(jobs):
        for row, values, delay in ((0, plan.disturbance_force, rig.force_delay), (1, plan.current, rig.input_delay)):
            if values is not None:
                charge = _charge(np.asarray(values, float), plan.hold, period, fine - delay)
                if row == 0:  # a force that is played at the beginning was played before; a current was not
                    charge += values[0] * np.minimum(fine - delay, 0.0)
                mean[:, row, b] = np.diff(charge) / step
        mean[:, 1, b] = np.clip(mean[:, 1, b], -rig.saturation, rig.saturation)
    lag = np.array([[rig.force_lag for rig, _, _ in jobs], [rig.current_lag for rig, _, _ in jobs]])
    if lag.any():
        decay = np.where(lag > 0, np.exp(-step / np.maximum(lag, 1e-300)), 0.0)
        weight = (1 - decay) * lag / step
        begin = [0.0 if plan.disturbance_force is None else plan.disturbance_force[0] for _, plan, _ in jobs]
        state = np.stack([np.asarray(begin, float), np.zeros(len(jobs))])
        for row in mean:
            gap = state - row
            state = row + gap * decay
            row += gap * weight
    for b, (rig, _, _) in enumerate(jobs):
        mean[:, 0, b] = _pushed(rig, mean[:, 0, b])
        mean[:, 1, b] = _motor(rig, mean[:, 1, b])
    return mean


def _random_impulses(jobs: Sequence[Job], holds: int, samples: int, period: float, step: float) -> np.ndarray | None:
    """Return the impulses per step of the white random force and torque, (N * holds, 2, B), or None."""
    if not any(rig.force_noise or rig.torque_noise for rig, _, _ in jobs):
        return None
    impulses = np.zeros((samples * holds, 2, len(jobs)))
    for b, (rig, _, seed) in enumerate(jobs):
        if rig.force_noise or rig.torque_noise:
            scale = np.array([rig.force_noise, rig.torque_noise]) * step / math.sqrt(period / holds)
            impulses[:, :, b] = scale * np.random.default_rng(seed).standard_normal((samples * holds, 2))
    return impulses


class _Friction:
    """Friction impulses of cart and arm, found together by a few Gauss-Seidel sweeps over the 2x2 problem.

    own is (2, B), the velocity change of each body per impulse on it; cross is (2, B), the velocity change of
    the cart per impulse on the arm, and of the arm per impulse on the cart. Both are renewed by the caller in
    place.
    """

    def __init__(self, batch: Batch, own: np.ndarray, cross: np.ndarray) -> None:
        self.bodies = [i for i, names in enumerate(DRY) if any(batch.rows(name) is not None for name in names)]
        self.limit, self.own, self.cross = batch.limit, own, cross
        self.reach, self.low, self.push, self.work, self.bare = (np.zeros_like(own) for _ in range(5))
        self.product = np.empty(own.shape[1])
        self.before = np.empty(own.shape[1])
        self.stops, self.slid = np.empty(own.shape[1], dtype=bool), np.empty(own.shape, dtype=bool)

    def apply(self, old: np.ndarray, new: np.ndarray) -> None:
        """Change in place the (2, B) velocities after the step, so far without friction."""
        if not self.bodies:
            return
        np.not_equal(old, 0.0, out=self.slid)
        np.multiply(self.own, self.limit, out=self.reach)
        np.negative(self.reach, out=self.low)
        if len(self.bodies) == 1:
            body = self.bodies[0]
            self._hold(body, old, new)
            np.multiply(self.cross[1 - body], self.push[body], out=self.work[body])
            np.add(new[1 - body], self.work[body], out=new[1 - body])
            return
        np.copyto(self.bare, new)
        self.push[:] = 0.0
        last = self.bodies[-1]
        for sweep in range(3):
            np.copyto(self.before, self.push[last])
            for body in self.bodies:
                np.multiply(self.cross[body], self.push[1 - body], out=new[body])
                np.add(new[body], self.bare[body], out=new[body])
                self._hold(body, old, new)
            # The next sweep would begin as this one did, and end so. Where all slide that is the third.
            if sweep == 1 and not np.count_nonzero(self.before != self.push[last]):
                return

    def _hold(self, body: int, old: np.ndarray, new: np.ndarray) -> None:
        """Apply friction to one body, given the other: it takes all of the velocity, or as much as it can."""
        free, taken, kept = new[body], self.work[body], self.product
        np.maximum(free, self.low[body], out=taken)
        np.minimum(taken, self.reach[body], out=taken)
        np.subtract(free, taken, out=free)
        np.multiply(old[body], free, out=kept)
        np.less_equal(kept, 0.0, out=self.stops)
        np.logical_and(self.stops, self.slid[body], out=self.stops)
        if np.count_nonzero(self.stops):
            # Sliding ends within the step; then the body rests, or slides the other way in what is left.
            rows = np.flatnonzero(self.stops)
            start, bound = old[body, rows], self.reach[body, rows]
            total = free[rows] + taken[rows]
            change = total - start
            before = np.minimum(abs(start) / (abs(change) + bound), 1.0)
            after = np.copysign(np.maximum(abs(change) - bound, 0.0) * (1 - before), change)
            free[rows] = after
            taken[rows] = total - after
        np.divide(taken, self.own[body], out=self.push[body])
        np.negative(self.push[body], out=self.push[body])


def _integrate(jobs: Sequence[Job], longest: float) -> list[Track]:
    rigs, plans = [job[0] for job in jobs], [job[1] for job in jobs]
    count, samples, period = len(jobs), plans[0].samples, plans[0].sample_time
    substeps = max(1, math.ceil(period / longest - 1e-9))
    step = period / substeps
    half = 0.5 * step

    x = np.array([[plan.initial_position for plan in plans], [plan.initial_angle for plan in plans]], dtype=float)
    v = np.array([[plan.initial_velocity for plan in plans], [plan.initial_arm_velocity for plan in plans]], float)
    batch = Batch(rigs, x, v, step)
    effects = [act for act in (build(batch) for build in BUILDERS) if act is not None]
    renew_bound = friction_bound(batch)
    predict = bool(effects) or renew_bound is not None
    turning = v[1]

    # Inputs: what is held over a sample, what changes within it.
    command, force = np.zeros((samples, count)), np.zeros((samples, count))
    for b, plan in enumerate(plans):
        if plan.current is not None:
            command[:, b] = np.clip(plan.current, -rigs[b].saturation, rigs[b].saturation)
        if plan.disturbance_force is not None:
            force[:, b] = _pushed(rigs[b], np.asarray(plan.disturbance_force, float))
    held = np.stack([force, np.stack([_motor(rig, command[:, b]) for b, rig in enumerate(rigs)], axis=1)], axis=1)
    held *= step
    late = [b for b, (rig, plan, _) in enumerate(jobs) if rig.drives_late or plan.hold != "zoh"]
    late_impulse = step * _late_drives([jobs[b] for b in late], period, substeps) if late else None
    holds = max(1, round(period / _HOLD))
    shaken = _random_impulses(jobs, holds, samples, period, step)

    # Sensors that lag are followed step by step.
    lags = np.stack([batch.column("lvdt_lag"), batch.column("tacho_lag"), batch.column("encoder_lag")])
    follow = np.where(lags > 0, 1 - np.exp(-step / np.where(lags > 0, lags, 1.0)), 1.0)
    lagging = bool(lags.any())
    there = np.array([rig.apart for rig in rigs])
    apart = bool(there.any())
    seen = np.stack([x[0], v[1], x[1]]) - lags * np.stack([v[0], 0.0 * v[1], v[1]])
    seen_out = np.empty((samples, 3, count))
    delayed = bool(batch.column("tacho_delay").any())
    speeds = np.empty((samples * substeps + 1 if delayed else 0, count))

    def shown() -> np.ndarray:
        """Return what the sensors look at between two steps: cart position, and velocity and angle of the rotor."""
        angle, speed = batch.rotor
        rotor = np.where(there, [speed, angle - half * speed], [v[1], x[1]])
        return np.stack([x[0], *rotor])

    # Constants of the step. A locked arm or a clamped cart takes no impulse and couples to nothing.
    moves = np.array([[plan.cart == "free" for plan in plans], [plan.arm == "free" for plan in plans]], dtype=float)
    held_fast = bool((moves == 0).any())
    eccentric = batch.column("eccentric_moment") * moves.prod(axis=0)
    couple = np.stack([step * eccentric, eccentric])
    mass, inertia = batch.column("total_mass") - batch.column("flexible_mass"), batch.column("lone_arm_inertia")
    spring = step * batch.column("spring_stiffness")
    viscous = step * np.stack([batch.column("cart_viscous"), np.zeros(count)])
    positive, negative = (
        step * batch.column("arm_viscous_positive"),
        step * batch.column("arm_viscous_negative"),
    )
    mean_viscous, difference = 0.5 * (positive + negative), 0.5 * (positive - negative)
    cart_inertia = mass + 0.5 * viscous[0]
    smooth_arm_inertia, asymmetric = inertia + 0.5 * mean_viscous, bool(difference.any())
    viscous[1] = mean_viscous

    # Work arrays.
    impulse, old, drive, new = batch.impulse, v.copy(), np.zeros_like(x), np.zeros_like(x)
    circle, coupled, moved, own, cross = (np.empty_like(x) for _ in range(5))
    friction = _Friction(batch, own, cross)
    work, swing, off, determinant = (np.empty(count) for _ in range(4))
    arm_inertia = smooth_arm_inertia.copy()
    out = np.empty((samples, 4, count))

    for n in range(samples):
        out[n, :2], out[n, 2:] = x, v
        seen_out[n] = np.where(lags > 0, seen, shown() if apart else np.stack([x[0], v[1], x[1]]))
        if delayed:
            speeds[n * substeps] = seen_out[n, 1]
        if n == samples - 1:
            break
        drive[:] = held[n]
        np.multiply(half, v, out=moved)
        x += moved
        for j in range(substeps):
            if late_impulse is not None:
                drive[:, late] = late_impulse[n * substeps + j]
            np.sin(x[1], out=circle[0])
            np.cos(x[1], out=circle[1])
            np.multiply(couple, circle, out=coupled)
            np.multiply(coupled[0], v[1], out=swing)
            np.subtract(coupled[1], swing, out=off)
            # Impulses of spring, damping, motor and the arm's centrifugal force.
            if asymmetric:
                np.sign(v[1], out=work)
                np.multiply(work, difference, out=work)
                np.add(work, mean_viscous, out=viscous[1])
                np.multiply(0.5, viscous[1], out=arm_inertia)
                np.add(arm_inertia, inertia, out=arm_inertia)
            np.multiply(viscous, v, out=impulse)
            np.subtract(drive, impulse, out=impulse)
            np.multiply(spring, x[0], out=work)
            np.subtract(impulse[0], work, out=impulse[0])
            np.multiply(swing, v[1], out=work)
            np.add(impulse[0], work, out=impulse[0])
            if predict:
                np.subtract(v, old, out=batch.predicted)
                batch.predicted *= 0.5
                batch.predicted += v
                batch.time = n * period + (j + 0.5) * step
                batch.motor[:] = drive[1]
                turning = batch.rotor[1].copy() if apart else v[1]
                for act in effects:
                    act()
                if renew_bound is not None:
                    renew_bound()
            if shaken is not None:
                impulse += shaken[n * holds + j * holds // substeps]
            if held_fast:
                impulse *= moves
            # The 2x2 system: [cart_inertia, off; coupled, arm_inertia] [dq', dtheta'] = impulse.
            np.multiply(cart_inertia, arm_inertia, out=determinant)
            np.multiply(off, coupled[1], out=work)
            np.subtract(determinant, work, out=determinant)
            np.divide(arm_inertia, determinant, out=own[0])
            np.divide(cart_inertia, determinant, out=own[1])
            np.divide(off, determinant, out=cross[0])
            np.divide(coupled[1], determinant, out=cross[1])
            np.negative(cross, out=cross)
            np.multiply(own, impulse, out=new)
            np.multiply(cross, impulse[::-1], out=moved)
            np.add(new, moved, out=new)
            np.add(new, v, out=new)
            friction.apply(v, new)
            if predict or lagging:
                np.copyto(old, v)
            if lagging:
                speed, angle = 0.5 * (old[1] + new[1]), x[1]
                if apart:
                    speed = np.where(there, 0.5 * (turning + batch.rotor[1]), speed)
                    angle = np.where(there, batch.rotor[0] - step * batch.rotor[1], angle)
                seen += follow * (np.stack([x[0], speed, angle]) - seen)
            np.copyto(v, new)
            if delayed:
                now = np.where(there, batch.rotor[1], v[1]) if apart else v[1]
                speeds[n * substeps + j + 1] = np.where(lags[1] > 0, seen[1], now)
            np.multiply(step if j < substeps - 1 else half, v, out=moved)
            np.add(x, moved, out=x)

    tracks = []
    for b, rig in enumerate(rigs):
        q, theta, speed, arm_speed = (np.array(out[:, row, b]) for row in range(4))
        seen_q, seen_w, seen_angle = (np.array(seen_out[:, row, b]) for row in range(3))
        if rig.channel_delay:
            time = period * np.arange(samples)
            line = CubicSpline(time, seen_q) if rig.lvdt_lag else CubicHermiteSpline(time, q, speed)
            late = time - rig.channel_delay
            seen_q = np.where(late < 0, q[0] + speed[0] * late, line(np.maximum(late, 0.0)))
        if rig.tacho_delay:
            fine = step * np.arange((samples - 1) * substeps + 1)
            seen_w = np.interp(period * np.arange(samples) - rig.tacho_delay, fine, speeds[: len(fine), b])
        tracks.append(Track(q, speed, theta, arm_speed, seen_q, seen_w, seen_angle))
    return tracks
