"""The files in which compiled programs outlive the process.

A program is found by what determines its tracing, and its code by what was traced: a change of the package's source that does not
change what is computed finds the same code again, after tracing.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import re
import shutil
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable

from rtac_jax.measurement.atomic_write import replacing
from rtac_jax.programs.compiler import compile_lowered
from rtac_jax.programs.environment import machine, patched, settings

FOLDER = "programs"
"""Where programs are kept, within the folder of JAX's cache of compiled code."""
_CODE = "code"
_CALLS = re.compile(r"custom_call @(\w+)")
_UNUSED = 30 * 24 * 3600  # seconds; what an older version of the package or of JAX has left is deleted then
_here = threading.local()


class Kept(NamedTuple):
    """A program as it stands in a file.

    Attributes:
        code: name of the file with its code.
        arguments: how many arrays it takes.
        result: what it returns, with a number in place of every array.
    """

    code: str
    arguments: int
    result: Any

    @property
    def structure(self) -> Any:
        """Structure of the result."""
        return jax.tree.structure(self.result)


def folder() -> Path | None:
    """Return the folder for programs; None where compiled code is not kept or not for a CPU, or the package has been patched."""
    config: Any = jax.config
    cache: str | None = config.jax_compilation_cache_dir
    return Path(cache) / FOLDER if cache and jax.default_backend() == "cpu" and not patched() else None


def loaded(file: Path) -> tuple[Callable[..., Sequence[Any]], Kept] | None:
    """Return the program that a file holds; None where there is none, or it or its code is damaged."""
    kept = _read(file)
    if not isinstance(kept, Kept):
        return None
    code = loaded_code(file.parents[1] / _CODE / kept.code, kept.arguments, kept.structure.num_leaves)
    return None if code is None else (code, kept)


def loaded_code(file: Path, arguments: int, results: int) -> Callable[..., Sequence[Any]] | None:
    """Return the code that a file holds, for so many arrays that it takes and returns; None where there is none."""
    executable = _read(file)
    if executable is None:
        return None
    _find_lapack()
    given = jax.tree.structure(((0,) * arguments, {}))
    # Whatever is wrong with it, the function can be traced and compiled.
    with contextlib.suppress(Exception):
        return serialize_executable.deserialize_and_load(executable, given, jax.tree.structure([0] * results))
    return None


def code_file(folder: Path, name: str, lowered: jax.stages.Lowered) -> Path | None:
    """Return where the code of a lowered function is kept; None where it calls what another process may not have."""
    text = lowered.as_text()
    if not all(called.startswith("lapack_") for called in _CALLS.findall(text)):
        return None
    # The text has no arguments that are not used, but code is called with all, and with none of another shape.
    given = [(argument.shape, str(argument.dtype)) for argument in jax.tree.leaves(lowered.in_avals)]
    digest = hashlib.sha256(repr((text, given, machine(), settings())).encode()).hexdigest()[:40]
    return folder / _CODE / f"{name}-{digest}"


def compile_and_save(lowered: jax.stages.Lowered, file: Path) -> jax.stages.Compiled:
    """Compile a lowered function and keep its code, unless it comes from JAX's cache.

    Code that was loaded from there lacks parts when it is written again.
    """
    with _watched_cache() as hits:
        compiled = compile_lowered(lowered)
    if not hits:
        with contextlib.suppress(Exception):  # code that has no such form
            _write(file, serialize_executable.serialize(compiled)[0])
    return compiled


def save(file: Path, kept: Kept) -> None:
    """Keep a program whose code is kept."""
    if (file.parents[1] / _CODE / kept.code).exists():
        _write(file, kept)


@functools.cache
def _find_lapack() -> None:
    """Let JAX look for LAPACK, as it does when it lowers the first call to it; without, loaded code crashes (jax#28908)."""
    jax.jit(jnp.linalg.cholesky).lower(jnp.eye(2))


@contextlib.contextmanager
def _watched_cache() -> Iterator[list[str]]:
    """Yield a list to which JAX adds when it finds code of this thread in its cache."""
    _watch()
    _here.hits = hits = []
    try:
        yield hits
    finally:
        del _here.hits


@functools.cache
def _watch() -> None:
    def hit(event: str, **_: object) -> None:
        if event == "/jax/compilation_cache/cache_hits" and hasattr(_here, "hits"):
            _here.hits.append(event)

    jax.monitoring.register_event_listener(hit)


def _write(file: Path, content: object) -> None:
    """Write to a file; what cannot be kept is compiled again, which only costs time."""
    try:
        packed = zlib.compress(pickle.dumps(content), level=1)
        if not file.parent.exists():
            _delete_unused(file.parents[1])
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as aside:
            aside.write_bytes(hashlib.sha256(packed).digest() + packed)
    except Exception:  # a full disk, a name too long, a result that cannot be pickled
        return


def _read(file: Path) -> Any:
    """Return what a file holds; None where there is none, or it is damaged."""
    try:
        content = file.read_bytes()
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            return None
        found = pickle.loads(zlib.decompress(content[32:]))
        for used in (file, file.parent):
            os.utime(used)
    except Exception:  # whatever is wrong with it, the function can be traced and compiled
        return None
    return found


def _delete_unused(folder: Path) -> None:
    """Delete folders of programs and files of code that nobody has used for long."""
    for other in (*folder.glob("*"), *(folder / _CODE).glob("*")):
        if time.time() - other.stat().st_mtime > _UNUSED:
            shutil.rmtree(other, ignore_errors=True) if other.is_dir() else other.unlink(missing_ok=True)
