"""Arguments of public functions: what is given in place of a model, a recording or a result is refused in one sentence."""

import collections.abc
import functools
import inspect
import os
import types
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin

Given = ParamSpec("Given")
Result = TypeVar("Result")

_OWN = ("rtac_jax", "estimators")
_SEVERAL = (collections.abc.Sequence, collections.abc.Iterable, list, tuple)


def checked_arguments(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Refuse arguments of another type where a parameter takes objects of these packages.

    Parameters that take anything else, as numbers and arrays, are left to the function.
    """
    signature = inspect.signature(function)
    asked = {name: kinds for name, p in signature.parameters.items() if (kinds := _kinds(p.annotation)) is not None}

    @functools.wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:  # too many, or one is missing: Python says so itself
            return function(*args, **kwargs)
        for name, (one, several) in asked.items():
            if name in given and not _fits(given[name], one, several):
                raise TypeError(_refusal(function.__qualname__, name, given, one, several))
        return function(*args, **kwargs)

    return checked


def _kinds(annotation: Any) -> tuple[tuple[type, ...], tuple[type, ...]] | None:
    """Return the classes that a parameter takes, and those of which it takes several; None if it takes anything else besides."""
    one: list[type] = []
    several: list[type] = []
    for member in _members(annotation):
        if member is type(None) or _is_own(member):
            one.append(member)
        elif get_origin(member) in _SEVERAL and all(map(_is_own, _members(get_args(member)[0]))):
            several.extend(_members(get_args(member)[0]))
        else:
            return None
    return (tuple(one), tuple(several)) if any(map(_is_own, (*one, *several))) else None


def _members(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


def _is_own(member: object) -> bool:
    """Return whether it is a class of these packages, of which one can ask whether an object is of it."""
    own = isinstance(member, type) and not get_args(member) and member.__module__.partition(".")[0] in _OWN
    return own and not getattr(member, "_is_protocol", False)


def _fits(value: object, one: tuple[type, ...], several: tuple[type, ...]) -> bool:
    if isinstance(value, one):
        return True
    if not several or isinstance(value, str | bytes | Mapping) or not isinstance(value, collections.abc.Iterable):
        return False
    return isinstance(value, collections.abc.Iterator) or all(isinstance(each, several) for each in value)


def _refusal(
    function: str, name: str, given: Mapping[str, Any], one: tuple[type, ...], several: tuple[type, ...]
) -> str:
    value = given[name]
    singles = [_named(kind) for kind in one if kind is not type(None)]
    wanted = " or ".join(
        [*singles, *([f"several of {', '.join(kind.__name__ for kind in several)}"] if several else [])]
    )
    what = f"the class {value.__name__}" if isinstance(value, type) else _named(type(value))
    return f"{function}: {name} is {what}, and must be {wanted}{_mend(name, given, (*one, *several))}."


def _mend(name: str, given: Mapping[str, Any], kinds: tuple[type, ...]) -> str:
    """Return what would mend it, where that can be told; classes go by name, as their modules import this one."""
    value, names = given[name], {kind.__name__ for kind in kinds}
    others = [other for other, held in given.items() if other != name and isinstance(held, kinds)]
    if others and type(None) not in kinds:
        return f"; it seems to stand at {others[0]}: look at the order of the arguments"
    if isinstance(value, type) and issubclass(value, kinds):
        return f"; make one, {value.__name__}(...)"
    if "RTAC" in names and type(getattr(value, "model", None)).__name__ == "RTAC":
        return "; give its model (.model)"
    if "Recording" in names or "Contents" in names:
        if isinstance(value, str | os.PathLike):
            return "; load it (rtac_jax.Recording.load)"
        held = list(value) if isinstance(value, list | tuple) else [value]
        if held and all(type(each).__name__ == "Experiment" for each in held):
            return "; make one of its experiments (rtac_jax.Recording([...]))"
    if isinstance(value, str | os.PathLike):
        return "; load it (estimators.load)"
    return ""


def _named(kind: type) -> str:
    """Return the name of a class with its article."""
    name = kind.__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' or name == 'RTAC' else 'a'} {name}"
