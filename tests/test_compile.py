"""Room for compiled code in long studies."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp

import rtac_jax as rtac
from estimators._compile import compile_only, make_room


def test_compiled_code_is_dropped_where_memory_maps_run_out(tmp_path: Path) -> None:
    traced = []

    @jax.jit
    def doubled(x: jax.Array) -> jax.Array:
        traced.append(1)
        return 2 * x

    maps, allowed = tmp_path / "maps", tmp_path / "allowed"
    maps.write_text("a line for each\n" * 60)
    allowed.write_text("100\n")
    doubled(jnp.ones(3))
    assert not make_room(maps, allowed, share=0.7)
    doubled(jnp.ones(3))
    assert len(traced) == 1
    assert make_room(maps, allowed)
    doubled(jnp.ones(3))
    assert len(traced) == 2
    assert not make_room(tmp_path / "not Linux", allowed)


def test_what_was_compiled_ahead_is_not_compiled_again() -> None:
    traced = []

    @jax.jit
    def tripled(x: jax.Array) -> jax.Array:
        traced.append(1)
        return 3 * x

    compile_only(tripled, jnp.ones(3))
    assert len(traced) == 1
    assert float(tripled(jnp.ones(3))[0]) == 3.0
    assert len(traced) == 1


def test_compiled_code_is_kept_where_the_environment_says() -> None:
    assert f"compile cache in {os.environ['JAX_COMPILATION_CACHE_DIR']}" in rtac.configure()
