"""The equations of motion as one linear regression: of a model's parameters and of effects beside it, without a simulation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.ndimage as ndimage
from jaxtyping import Bool, Float, Int

from estimators.closed_form.initial_angle import with_initial_angles
from estimators.closed_form.modulating_functions import WeakMotion, integrated_terms, weak_motion
from estimators.closed_form.regressors import Terms
from estimators.closed_form.static_regressors import Added, Regressor, added_along, is_static, regressors_of
from rtac_jax import RTAC
from rtac_jax.effects import Effect, Motion
from rtac_jax.measurement import Experiment

Rows = Float[np.ndarray, " _"]
Columns = Float[np.ndarray, "_ _"]
Each = Float[np.ndarray, "2"]
"""One number for the cart's equation and one for the arm's."""

_NEAR_ZERO = 0.2  # of the cart's fastest stretch, below which its test functions are left out
_RESTS = 5.0  # standard deviations of the noise of its smooth velocity below which the arm rests
_AT_REST = 5  # samples in a row for which it must
_MOST = 50_000  # rows of the arm's equation in all: neighbours share most of their samples, and thin out without loss
_WEIGHINGS = 4  # times each equation is weighted by what the last solution left of it
# Parameter, and the term of the cart's and of the arm's equation that it multiplies; the motor's torque drives the arm.
_TERMS = {
    "total_mass": ("mass", None),
    "arm_inertia": (None, "inertia"),
    "eccentric_moment": ("swing", "reaction"),
    "spring_stiffness": ("spring", None),
    "torque_constant": (None, "current"),
    "cart_viscous.coefficient": ("viscous", None),
    "cart_coulomb.level": ("dry", None),
    "arm_viscous.positive": (None, "positive"),
    "arm_viscous.negative": (None, "negative"),
}
_SCALES = ("total_mass", "arm_inertia")  # without which both equations could be nothing equals nothing


@dataclasses.dataclass(frozen=True)
class Solution:
    """A least-squares solution of both equations.

    Attributes:
        values: of those parameters of the model that the data tell anything of, by name, SI units.
        amplitudes: of the effects beside it, one for each column.
        squares: squared error of each equation.
    """

    values: dict[str, float]
    amplitudes: Float[np.ndarray, " column"]
    squares: Each


class _Part(NamedTuple):
    """One experiment; of its rows every `thinned`-th counts."""

    experiment: Experiment
    motion: WeakMotion
    terms: Terms
    thinned: int = 1


class Columned(NamedTuple):
    """An effect beside the model as columns of the regression.

    Attributes:
        regressor: the effect.
        columns: one for each amplitude; of an effect that is tried at a fixed size, none.
        target: what of the target it explains already: of an effect of fixed size all that it adds.
        drive: rows that the torque constant's column changes by, where dry friction takes up what drives the arm.
    """

    regressor: Regressor
    columns: Columns
    target: Rows
    drive: Rows


@dataclasses.dataclass(frozen=True)
class MotionRegression:
    """Both equations of motion of all experiments against test functions, ready to be solved.

    A row is one test function on one equation. Every term is linear in its parameter, so that a model whose simulation follows
    nothing has estimates here, and so has each effect that is a function of the motion at one instant.

    Attributes:
        names: of the parameters of the model that are estimated.
        columns: of these.
        target: what they are to explain.
        on_arm: rows of the arm's equation.
        floor: squared error that the noise of the sensors leaves of each equation.
        independent: number of rows of each equation that share no samples.
    """

    names: tuple[str, ...]
    columns: Columns
    target: Rows
    on_arm: Bool[np.ndarray, " row"]
    floor: Each
    independent: Each
    _parts: tuple[_Part, ...]
    _motion: Motion
    _rests: Bool[np.ndarray, " sample"]

    def without(self, effects: Sequence[Effect]) -> "MotionRegression":
        """Return the equations with what static effects add, beyond the paper's, taken out of the target at their sizes."""
        target = self.target
        for effect in effects:
            if is_static(type(effect)) and not any(name.startswith(f"{effect.id}.") for name in _TERMS):
                target = target + self.rows_of(added_along(effect, self._motion, self._rests))
        return dataclasses.replace(self, target=target)

    def beside(self, instance: Effect) -> list[Columned]:
        """Return an effect of plausible size as columns: once, or once for each size that is tried."""
        found = []
        for regressor in regressors_of(instance, self._motion, self._rests):
            columns = np.stack([-self.rows_of(part) for part in regressor.parts], axis=1)
            if not np.all(np.isfinite(columns)):
                continue
            none = np.zeros(len(columns))
            drive = self._held() if regressor.holds else none
            if regressor.amplitudes:
                found.append(Columned(regressor, columns, none, drive))
            else:
                found.append(Columned(regressor, columns[:, :0], columns[:, 0], drive))
        return found

    def solved(self, several: Sequence[Columned] = ()) -> Solution:
        """Solve for the parameters of the model and the amplitudes of several effects beside it.

        The equations are weighted by what they leave of each other.
        """
        base = self.columns
        if several and "torque_constant" in self.names:
            place = self.names.index("torque_constant")
            base = base.copy()
            base[:, place] += max((one.drive for one in several), key=np.linalg.norm)
        target = self.target - np.sum([one.target for one in several], axis=0) if several else self.target
        whole = np.column_stack([base, *(one.columns for one in several), target])
        # Least squares need no more of the rows than their triangular factor.
        parts = [np.asarray(np.linalg.qr(whole[self.on_arm == arm], mode="r")) for arm in (False, True)]
        weights, values, squares = np.ones(2), np.zeros(whole.shape[1] - 1), np.zeros(2)
        for _ in range(_WEIGHINGS):
            values = _least_squares(np.concatenate([w * part for w, part in zip(weights, parts, strict=True)]))
            squares = np.array([np.sum((part[:, -1] - part[:, :-1] @ values) ** 2) for part in parts])
            weights = 1.0 / np.sqrt(np.maximum(squares, np.maximum(self.floor, 1e-300)))
        told = np.linalg.norm(base, axis=0) > 0
        known = {name: float(value) for name, value, there in zip(self.names, values, told, strict=False) if there}
        return Solution(known, values[len(self.names) :], squares)

    def gain(self, before: Solution, after: Solution, parameters: int) -> float:
        """Return what a solution gains in BIC over one with so many parameters less.

        Only rows that share no samples count as different data, and what the noise of the sensors leaves is no error.
        """
        first, last = (one.squares + np.maximum(self.floor, 1e-300) for one in (before, after))
        price = parameters * np.log(max(np.sum(self.independent), 1.0))
        return float(np.sum(self.independent * np.log(first / last)) - price)

    def misfit(self, solution: Solution, inertia: float) -> float:
        """Return twice the negative log-likelihood of a solution, the arm's equation divided by the inertia that it knew.

        So that solutions with different inertias compare: undivided, the arm's equation is nothing equals nothing without one.

        Args:
            solution: of these equations.
            inertia: of the arm [kg m^2], as the model has it.
        """
        squares = (solution.squares + np.maximum(self.floor, 1e-300)) / np.array([1.0, inertia**2])
        return float(np.sum(self.independent * np.log(squares)))

    @property
    def motion(self) -> Motion:
        """Return the motion along which the equations are, one element a sample of all experiments one after the other."""
        return self._motion

    def stretches(self, parts: int) -> Int[np.ndarray, " row"]:
        """Return the number of the stretch of time of each row, of so many in each experiment."""
        found = []
        for number, part in enumerate(self._parts):
            for rows in _both(part, "mass", "inertia"):
                found.append(number * parts + np.arange(len(rows)) * parts // max(len(rows), 1))
        return np.concatenate(found)

    def rows_of(self, added: Added) -> Rows:
        """Return what is added to both equations, against the test functions."""
        found, begin = [], 0
        for part in self._parts:
            place = slice(begin, begin + part.experiment.samples)
            begin = place.stop
            cart = part.motion.on_cart(added.cart[place])
            arm = part.motion.on_arm(added.arm[place])
            found += _both(part, cart, arm)
        return np.concatenate(found)

    def _held(self) -> Rows:
        """Return the current while the arm rests, against the test functions."""
        current = np.where(self._rests, np.asarray(self._motion.current), 0.0)
        return self.rows_of(Added(np.zeros_like(current), current))


def motion_regression(
    model: RTAC, experiments: Sequence[Experiment], levels: Mapping[str, float]
) -> MotionRegression | None:
    """Return the equations of motion of a model along measured motions; None where no experiment shows what they need.

    Total mass and inertia of the arm fix the scale and are taken as the model has them, and so is what it has beyond the paper's.

    Args:
        model: says which parameters there are and which of them are fixed.
        experiments: that move.
        levels: noise of each channel, SI units.

    Source: Shinbrot, Trans. ASME 79 (1957), modulating functions; Messenger and Bortz, SIAM Multiscale Model. Simul. 19 (2021), the
    same to select the terms of an unknown equation.
    """
    parts = []
    for experiment in with_initial_angles(model, experiments, levels):
        try:
            motion = weak_motion(experiment, levels)
        except ValueError:
            continue
        if experiment.arm == "locked" or motion.has_arm:  # else the arm's reaction acts on the cart, and nobody saw it
            parts.append(
                _Part(experiment, motion, integrated_terms(experiment, levels, near_zero=_NEAR_ZERO, motion=motion))
            )
    if not parts:
        return None
    most = sum(len(part.terms.arm["inertia"]) for part in parts)
    parts = [part._replace(thinned=-(-most // _MOST)) for part in parts]
    rows = {name: np.concatenate([r for part in parts for r in _both(part, *terms)]) for name, terms in _TERMS.items()}
    rows["torque_constant"] *= -1.0
    names = tuple(name for name in _TERMS if name in model.free and name not in _SCALES and np.any(rows[name]))
    target = np.concatenate([r for part in parts for r in _both(part, "force", None)])
    for name in [n for n in _TERMS if n in model.parameters and n not in names]:
        target = target - _value(model, name) * rows[name]
    sizes = [[len(r) for r in _both(part, "mass", "inertia")] for part in parts]
    on_arm = np.concatenate([np.repeat([False, True], size) for size in sizes])
    scales = [_value(model, name) for name in _SCALES]
    noise = np.concatenate(
        [np.repeat(np.multiply(scales, part.terms.noise), size) for part, size in zip(parts, sizes, strict=True)]
    )
    lag = max(max(part.terms.lag / part.thinned for part in parts), 1)
    joined = _joined(parts, model)
    found = MotionRegression(
        names=names,
        columns=np.stack([rows[name] for name in names], axis=1) if names else np.zeros((len(target), 0)),
        target=target,
        on_arm=on_arm,
        floor=np.array([np.sum(noise[on_arm == arm] ** 2) for arm in (False, True)]),
        independent=np.array([np.sum(~on_arm), np.sum(on_arm)]) / lag,
        _parts=tuple(parts),
        _motion=joined,
        _rests=np.concatenate([_at_rest(part, levels) for part in parts]),
    )
    # Effects that pull at the eccentric mass ask for it, and the cart's equation tells it, whatever acts on the arm.
    moment = found.solved().values.get("eccentric_moment", 0.0)
    if moment > 0 and moment**2 < np.prod(scales):
        body = dataclasses.replace(model.body, eccentric_moment=moment)
        found = dataclasses.replace(found, _motion=joined._replace(body=body))
    return found.without(model.effects)


def _least_squares(rows: Columns) -> Float[np.ndarray, " column"]:
    """Return the solution of rows that end with what is to be explained, columns scaled to one size."""
    size = np.linalg.norm(rows[:, :-1], axis=0)
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=1e-10)[0] / size


def _value(model: RTAC, name: str) -> float:
    return float(np.mean(np.asarray(model[name])))


def _both(part: _Part, cart: str | Rows | None, arm: str | Rows | None) -> list[Rows]:
    """Return the rows of both equations that count: of the cart's where it slides, of the arm's where it is free and seen."""
    terms = part.terms
    seen = part.experiment.arm == "free" and terms.has_arm
    on_cart, on_arm = len(terms.sliding), len(terms.arm["inertia"])
    first = np.zeros(on_cart) if cart is None else terms.cart[cart] if isinstance(cart, str) else cart
    last = np.zeros(on_arm) if arm is None else terms.arm[arm] if isinstance(arm, str) else arm
    return [first[terms.sliding][:: part.thinned], (last if seen else last[:0])[:: part.thinned]]


def _input(experiment: Experiment, channel: str) -> Float[np.ndarray, " sample"]:
    """Return an input; zeros where there is none."""
    signal = experiment.inputs.get(channel)
    return np.zeros(experiment.samples) if signal is None else np.asarray(signal.values)


def _joined(parts: Sequence[_Part], model: RTAC) -> Motion:
    """Return the measured motion of all experiments one after the other, as effects take it."""
    position, velocity, angle, omega = (
        jnp.asarray(np.concatenate([getattr(part.motion, name) for part in parts]))
        for name in ("position", "velocity", "angle", "turning")
    )
    current, force = (
        jnp.asarray(np.concatenate([_input(part.experiment, channel) for part in parts]))
        for channel in ("current", "disturbance_force")
    )
    return Motion(position, velocity, angle, omega, jnp.sin(angle), jnp.cos(angle), current, model.body, force=force)


def _at_rest(part: _Part, levels: Mapping[str, float]) -> Bool[np.ndarray, " sample"]:
    """Return the samples at which the arm rests, by its smooth velocity."""
    motion, dt = part.motion, part.experiment.sample_time
    band = min(8 * motion.band, 0.33 / dt)
    noise = levels.get("arm_velocity", 0.0) * np.sqrt(2 * band * dt)
    if motion.from_angle:
        noise = levels.get("arm_angle", 0.0) * 2 * np.pi * band * np.sqrt(2 * band * dt / 3)
    slow = np.abs(motion.turning) <= _RESTS * noise
    return ndimage.binary_opening(slow, np.ones(_AT_REST, bool))
