"""Every test runs with shapes and types checked, in double precision, and with compiled code kept between runs."""

import functools
import gc
import itertools
import os
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import pytest

ROOT = Path(__file__).parents[1]
# These check what they are given themselves, with messages of their own, and their tests give them wrong types.
DOORS = {"measurement", "virtual_rig"}
FIRST_CALLS, ONE_OF = 200, 20

# For this process, and for the notebooks that it runs.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(ROOT / ".cache" / "jax")
_checked = jaxtyping.jaxtyped


def _checked_where_it_stays(fn: Any = None, *, typechecker: Any = None) -> Any:
    """Check functions of modules and classes; one within a function is made anew at every call, and its checks would be with it."""
    if fn is None:
        return lambda fn: _checked_where_it_stays(fn, typechecker=typechecker)
    if "<locals>" in getattr(fn, "__qualname__", ""):
        return fn
    if not isinstance(fn, type) and not any(map(_has_shape, getattr(fn, "__annotations__", {}).values())):
        return typechecker(fn)  # checks the same, and a call costs a tenth of what looking for shapes does
    checked = _checked(fn, typechecker=typechecker)
    return checked if isinstance(fn, type) else _sampled(fn, checked)


def _sampled(fn: Callable[..., Any], checked: Callable[..., Any]) -> Callable[..., Any]:
    """Check the first calls of a function and one of many after them: loops call some a million times with the same shapes."""
    calls = itertools.count()

    @functools.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        number = next(calls)
        return (checked if number < FIRST_CALLS or not number % ONE_OF else fn)(*args, **kwargs)

    return call


def _has_shape(hint: Any) -> bool:
    """Return whether an annotation says something of shapes; one that is given as text may."""
    if isinstance(hint, str):
        return True
    made_here = type(hint).__module__.partition(".")[0] == "jaxtyping"
    return made_here or any(map(_has_shape, typing.get_args(hint)))


jaxtyping.jaxtyped = _checked_where_it_stays
# Before anything of the packages is imported: the hook rewrites their modules as they load.
parts = {path.stem for path in (ROOT / "rtac_jax").iterdir() if not path.name.startswith("__")} - DOORS
jaxtyping.install_import_hook([*(f"rtac_jax.{part}" for part in sorted(parts)), "estimators"], "beartype.beartype")

import matplotlib  # noqa: E402 - after the hook

import rtac_jax  # noqa: E402 - after the hook
from estimators.core import progress  # noqa: E402 - after the hook
from estimators.core.compilation import make_room  # noqa: E402 - after the hook
from rtac_jax.programs import forget_programs  # noqa: E402 - after the hook

rtac_jax.configure()
# What tests read of a command is not to hang on when the process began.
progress._LINE = 1e9
# Tracing makes many objects that stay: looking through them as often as Python does by itself costs a twentieth of the time.
gc.set_threshold(50_000, 20, 100)
matplotlib.use("Agg")


# What takes longest, the longest first: begun last, it would leave one of two workers alone with it.
LONGEST = (
    "test_notebooks",
    "test_readme",
    "cli/",
    "diagnosis/",
    "study/",
    "linear/",
    "inference/",
    "core/",
    "experiment_design/",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        path = item.path.relative_to(ROOT / "tests").as_posix()
        return next((n for n, beginning in enumerate(LONGEST) if path.startswith(beginning)), len(LONGEST))

    items.sort(key=place)


@pytest.fixture
def compile_anew() -> Iterator[Callable[[], None]]:
    """Give what drops all compiled code, for tests that change constants of modules, which compiled code does not know of."""

    def drop() -> None:
        forget_programs()
        jax.clear_caches()

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield drop
    drop()
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture(autouse=True, scope="module")
def _compiled_code_is_dropped() -> Iterator[None]:
    """Thousands of compiled functions in one process use up the memory maps that the kernel allows, and then it crashes.

    A module needs up to half of them, and what the one before it has compiled may serve it too.
    """
    yield
    make_room(fraction=0.2)
