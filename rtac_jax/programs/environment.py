"""The environment of tracing: all that determines what is traced and compiled beside a function and its arguments."""

import contextlib
import functools
import hashlib
import os
import platform
import sys
import types
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rtac_jax.programs.compiler import OPTIONS

PACKAGES = ("rtac_jax", "estimators")
"""Whose source determines what is traced."""
LIBRARIES = ("jax", "jaxlib", "equinox", "jaxtyping", "lineax", "optimistix", "numpy")
"""Whose versions determine it too."""


def environment() -> str:
    """Return a name for all that determines what is traced beside the function and its arguments."""
    known = _sources(), machine(), settings()
    return hashlib.sha256(repr(known).encode()).hexdigest()[:20]


def settings() -> tuple[Any, ...]:
    """Return JAX's settings, whether numbers are double, and the compiler's options."""
    chosen = {k: v for k, v in jax.config.values.items() if "cache" not in k and "log" not in k}
    return sorted(map(repr, chosen.items())), str(jnp.result_type(float)), (os.environ.get("XLA_FLAGS"), OPTIONS)


@functools.cache
def _sources() -> str:
    """Return a digest of the source of the package."""
    digest = hashlib.sha256()
    for name in PACKAGES:
        package = Path(__file__).parents[2] / name
        for file in sorted(package.rglob("*.py")):
            digest.update(f"{name}/{file.relative_to(package)}\0".encode() + file.read_bytes())
    return digest.hexdigest()


@functools.cache
def machine() -> str:
    """Return the versions of libraries, and the name of the processor and what it can do, for which code is compiled."""
    versions = []
    for library in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions.append(f"{library} {metadata.version(library)}")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:  # not Linux
        processor = [platform.processor()]
    return repr((versions, sys.version, platform.machine(), processor))


def patched() -> bool:
    """Return whether a function of the package, or a method of a class, was replaced by one from elsewhere.

    Then its source does not tell what is traced.
    """
    modules = [m for name, m in list(sys.modules.items()) if m is not None and name.partition(".")[0] in PACKAGES]
    for module in modules:
        for value in list(vars(module).values()):
            owned = isinstance(value, type) and value.__module__.partition(".")[0] in PACKAGES
            for one in (value, *(vars(value).values() if owned else ())):
                if type(one) is types.FunctionType:
                    root = one.__module__.partition(".")[0]
                    if root not in PACKAGES and _foreign(root):
                        return True
    return False


@functools.cache
def _foreign(root: str) -> bool:
    """Return whether a module is neither of Python nor installed."""
    if root in sys.stdlib_module_names:
        return False
    file = getattr(sys.modules.get(root), "__file__", None)
    return file is None or not {"site-packages", "dist-packages"} & set(Path(file).parts)
