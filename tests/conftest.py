"""Every test runs with shapes and types checked, in double precision, and with compiled code kept between runs."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

ROOT = Path(__file__).parents[1]
# These check what they are given themselves, with messages of their own, and their tests give them wrong types.
DOORS = {"measurement", "virtual_rig"}

# For this process, and for the notebooks that it runs.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(ROOT / ".cache" / "jax")
# Before anything of the packages is imported: the hook rewrites their modules as they load.
parts = {path.stem for path in (ROOT / "rtac_jax").iterdir() if not path.name.startswith("__")} - DOORS
jaxtyping.install_import_hook([*(f"rtac_jax.{part}" for part in sorted(parts)), "estimators"], "beartype.beartype")

import matplotlib  # noqa: E402 - after the hook

import rtac_jax  # noqa: E402 - after the hook
from estimators.core.compilation import make_room  # noqa: E402 - after the hook

rtac_jax.configure()
# Tracing makes many objects that stay: looking through them as often as Python does by itself costs a twentieth of the time.
gc.set_threshold(50_000, 20, 100)
matplotlib.use("Agg")


@pytest.fixture(autouse=True, scope="module")
def _compiled_code_is_dropped() -> Iterator[None]:
    """Thousands of compiled functions in one process use up the memory maps that the kernel allows, and then it crashes.

    A module needs up to half of them, and what the one before it has compiled may serve it too.
    """
    yield
    make_room(share=0.2)
