"""The contract of a user's own effect: every method is traced, and computed where nothing moves; faults are told."""

import inspect
import re
import traceback
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rtac_jax._rigid_body import RigidBody
from rtac_jax._rtac import RTAC
from rtac_jax.effects import (
    PORTS,
    Actuator,
    DryFriction,
    Effect,
    Force,
    Impact,
    Input,
    Motion,
    Outputs,
    Sensor,
    in_parts,
)
from rtac_jax.parameters import Scales, declarations
from rtac_jax.programs.arrays import is_traced

# A rig as the paper's, swinging some millimetres: sizes for which `plausible` must answer.
TYPICAL = Scales(
    position=5e-3,
    velocity=5e-2,
    arm_velocity=10.0,
    current=0.1,
    force=0.7,
    torque=1e-2,
    frequency=10.4,
    mass=1.23,
    sample_time=5e-3,
    applied_force=0.3,
)
# One trajectory for each element; not 1, so that a reduction over all of them shows.
TRAJECTORIES = (3, 4)
_OURS = ("rtac_jax", "estimators")  # packages whose effects have tests of their own
_WORKING: "weakref.WeakSet[type[Effect]]" = weakref.WeakSet()  # those of others that were asked
_PORTS = ("on the cart", "on the arm")
_AT_ANY_MOTION = ("rate", "force", "levels", "current", "read")
# What JAX calls a value in a traced function, and the object that stands for it.
_VALUE = re.compile(r"\b(\w+Tracer|ShapeDtypeStruct)\b(\([^()]*\))?")


def require_working(c: type[Effect]) -> None:
    """Call every method of a class of effects on traced values, and those of the motion where nothing moves.

    Raises:
        ValueError: one fails, or returns what the model cannot use; it names the effect, the method, the line and the mend.
    """
    for name, declared in declarations(c).items():
        if declared.plausible is not None:
            sizes = explained(c, f"plausible of {name}", lambda size=declared.plausible: size(TYPICAL))
            for size in sizes if isinstance(sizes, tuple) else (sizes,):
                _require_number(c, f"plausible of {name}", size)
    effect = explained(c, "making an instance of plausible size", lambda: c.candidates(TYPICAL)[0])
    for several in TRAJECTORIES:  # what fits one number of them may fit no other
        _require_methods(c, effect, (several,))


def require_working_model(model: RTAC, *, batch: bool = True) -> None:
    """Refuse values that are no numbers, and call every method of the user's own effects in a model, as `require_working` does.

    A class is asked once. One whose numbers are traced, or several of a kind as for a batch, is let pass.

    Args:
        model: to be simulated or fitted.
        batch: allow several values of any parameter, and not only of those that each experiment has for itself.

    Raises:
        ValueError: a value is not finite or several stand where there is one, or an effect fails or returns what the model
            cannot use.
    """
    _require_numbers(model, batch)
    for effect in model.effects:
        known = type(effect) in _WORKING or type(effect).__module__.partition(".")[0] in _OURS
        if known or is_traced(effect):
            continue
        if any(np.ndim(leaf) for leaf in jax.tree.leaves(effect)):
            continue
        for several in TRAJECTORIES:
            _require_methods(type(effect), effect, (several,))
        _WORKING.add(type(effect))


def _require_numbers(model: RTAC, batch: bool) -> None:
    """Refuse values of parameters that no simulation can use."""
    for name in model.parameters:
        value = model[name]
        if is_traced(value):
            continue
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{name} is {value}; give it a finite number (model.with_values).")
        if np.ndim(value) and not batch and name not in model.per_experiment:
            raise ValueError(
                f"{name} has {np.size(value)} values; give it one, or let each experiment have its own (model.each_experiment)."
            )


def _require_methods(c: type[Effect], effect: Effect, several: tuple[int]) -> None:
    """Call every method of an effect on so many trajectories."""

    def called(method: str, *arguments: object) -> Any:
        told = explained(
            c, method, lambda: eqx.filter_eval_shape(lambda e, given: getattr(e, method)(*given), effect, arguments)
        )
        if method in _AT_ANY_MOTION:
            moved.append((method, arguments))
        return told

    moved: list[tuple[str, Any]] = []

    motion, own = _motion(several), ()
    if not (isinstance(effect.states, dict) and all(isinstance(x, str) for one in effect.states.items() for x in one)):
        raise ValueError(
            f"effect {c.id}: states is {effect.states!r}; give a dictionary from each state's name to its unit."
        )
    if effect.port not in PORTS:
        raise ValueError(f"effect {c.id}: port is {effect.port!r}; use one of {', '.join(PORTS)}.")
    names = tuple(effect.states)
    own = in_parts(called("start", motion), effect, "start", names)
    _require_shapes(effect, several, "start", own)
    if effect.closed:
        _require_shapes(effect, several, "follow", in_parts(called("follow", motion, own), effect, "follow", names))
    else:
        _require_shapes(effect, several, "rate", in_parts(called("rate", motion, own), effect, "rate", names))
    if isinstance(effect, Force):
        _require_shapes(effect, several, "force", in_parts(called("force", motion, own), effect, "force", _PORTS))
        _require_shapes(effect, several, "cart_mass", (called("cart_mass"),))
        _require_shapes(effect, several, "arm_inertia", (called("arm_inertia", motion.body),))
    elif isinstance(effect, DryFriction):
        _require_shapes(effect, several, "levels", in_parts(called("levels", motion, own), effect, "levels", _PORTS))
    elif isinstance(effect, Impact):
        parts = ("states", "impulse", "moment")
        after, *pushed = in_parts(called("strike", motion, own, _values(several)), effect, "strike", parts)
        _require_shapes(effect, several, "strike", (*in_parts(after, effect, "strike", names), *pushed))
    elif isinstance(effect, Actuator):
        _require_shapes(effect, several, "current", (called("current", _values(several), own),))
    elif isinstance(effect, Input):
        pieces = jnp.ones((5, 2, *several))
        told = called("transform", pieces, "current", jnp.full(several, 5e-3))
        if len(getattr(told, "shape", ())) != 3 or (told.shape[0], told.shape[2]) != (5, *several):
            raise ValueError(
                f"effect {effect.id}: transform returns {_what(told)} for pieces of shape {pieces.shape}; "
                "return one polynomial for each interval and experiment: [sample, power, experiment]."
            )
    if isinstance(effect, Sensor) or type(effect).read is not Effect.read:
        told = called("read", Outputs(_values(several), _values(several), _values(several)), own)
        _require_shapes(effect, several, "read", in_parts(told, effect, "read", Outputs._fields))
    for method, arguments in moved:
        _require_finite(effect, method, arguments)


def explained(c: type[Effect], method: str, call: Callable[[], Any]) -> Any:
    """Return what a call into an effect returns; whatever the user's code raises becomes a sentence.

    Raises:
        ValueError: the call fails.
    """
    try:
        return call()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a user's exit() is one, too, and would end the program without a word
        raise ValueError(f"effect {c.id}: {method}{_line(c, error)} {_fault(error)}.") from error


def _fault(error: BaseException) -> str:
    """Return what usually is behind an error in a traced function, and the usual mend."""
    said = _VALUE.sub("a value that is known only later", (str(error).splitlines() or [""])[0].rstrip("."))
    if isinstance(error, SystemExit):
        return "calls exit(); raise an error instead"
    if isinstance(error, jax.errors.TracerBoolConversionError) or "truth value of an array" in said.lower():
        return "decides with a Python if, while, and, or or not on a value that is known only later; use jnp.where instead of if"
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return "calls NumPy on a value that is known only later; use jax.numpy (jnp) in place of numpy (np)"
    if isinstance(error, ZeroDivisionError):
        return "divides by zero; keep the divisor away from 0, for which jnp.where or a small constant helps"
    if isinstance(error, jax.errors.ConcretizationTypeError) or (isinstance(error, TypeError) and "scalar" in said):
        return "turns a value that is known only later into a Python number; use jnp.sin instead of math.sin, and no float()"
    if isinstance(error, TypeError) and "immutable" in said:
        return "writes into an array; use x.at[i].set(value), which returns another one"
    return (
        f"fails: {type(error).__name__}{f': {said}' if said else ''}; mend it, or see the whole traceback with --debug"
    )


def _line(c: type[Effect], error: BaseException) -> str:
    """Return where in the user's file it failed."""
    try:
        file = inspect.getfile(c)
    except (TypeError, OSError):  # typed in, without a file
        return ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f" ({Path(file).name}, line {lines[-1]})" if lines else ""


def _require_number(c: type[Effect], method: str, told: object) -> None:
    try:
        good = bool(np.isfinite(np.asarray(told, dtype=float)).all())
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"effect {c.id}: {method} returns {told!r}; return a finite number, or a tuple of them.")


def _require_shapes(effect: Effect, several: tuple[int], method: str, told: tuple[Any, ...]) -> None:
    for part in told:
        shape = getattr(part, "shape", () if isinstance(part, (int, float)) else None)
        kind = getattr(getattr(part, "dtype", None), "kind", "f")
        if shape is None or kind not in "fiu" or shape not in ((), several):
            raise ValueError(
                f"effect {effect.id}: {method} returns {_what(part)} where one number for each trajectory was expected "
                f"(shape {several}, as motion.cart_position has it, or none); "
                f"{'compute element by element with jnp' if kind in 'fiu' else 'return real numbers'}."
            )


def _require_finite(effect: Effect, method: str, arguments: tuple[Any, ...]) -> None:
    """Refuse a method that is no number, or has no slope, where cart and arm stand still at zero, as every rest record does."""
    still = jax.tree.map(lambda x: x if np.ndim(x) == 0 else jnp.zeros_like(x), arguments)
    still = tuple(x._replace(cos_angle=jnp.ones_like(x.cos_angle)) if isinstance(x, Motion) else x for x in still)

    def along(tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.ones_like(x) if eqx.is_inexact_array(x) else None, tree)

    def told() -> tuple[Any, Any]:
        return eqx.filter_jvp(
            lambda e, given: getattr(e, method)(*given), (effect, still), (along(effect), along(still))
        )

    value, slope = explained(type(effect), method, told)
    for found, of in ((value, ""), (slope, "the slope of ")):
        if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(found)):
            raise ValueError(
                f"effect {effect.id}: {of}{method} is no number where nothing moves (position, velocities, current and angle "
                "0); keep what divides or stands under a root away from 0, for which jnp.where or a small constant helps."
            )


def _what(told: Any) -> str:
    shape = getattr(told, "shape", None)
    return f"the value {told!r}"[:60] if shape is None else f"an array of shape {shape} and type {told.dtype}"


def _values(several: tuple[int]) -> jax.Array:
    return jnp.linspace(0.1, 0.3, *several)


def _motion(several: tuple[int]) -> Motion:
    value = _values(several)
    body = jax.tree.map(jnp.asarray, RigidBody(1.23, 9.5e-5, 1.06e-3, 132.6, 8.04e-2))
    sides = (value, value, value, value, jnp.sin(value), jnp.cos(value), value, body)
    began = Motion(*sides)
    return Motion(*sides, began, 0.5, 5e-3, value, value, value)
