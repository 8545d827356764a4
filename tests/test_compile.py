"""Room for compiled code in long studies, code compiled ahead, and work beside what is computed."""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import rtac_jax as rtac
from estimators._beside import beside
from estimators._compile import Ahead, compile_only, make_room


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


def test_pieces_compiled_ahead_are_waited_for_one_by_one() -> None:
    done: list[str] = []
    hold = threading.Event()

    def failing() -> None:
        done.append("failed")
        raise RuntimeError("no room for the code")

    def held() -> None:
        assert hold.wait(timeout=60)
        done.append("last")

    with ThreadPoolExecutor(1) as other:
        ahead = Ahead(other, [lambda: done.append("first"), failing, held])
        ahead.next()
        assert done[0] == "first"
        ahead.next()  # what failed there says so where it runs
        assert done == ["first", "failed"]
        hold.set()
        ahead.next()
        assert done == ["first", "failed", "last"]
        ahead.next()  # nothing is left to wait for


def test_work_is_done_beside_what_is_computed() -> None:
    """The second is computed before the work on the first is done, or this would wait forever."""
    computed = threading.Event()

    def values() -> Iterator[int]:
        yield 1
        computed.set()
        yield 2

    def worked(value: int) -> int:
        assert computed.wait(timeout=60)
        return 10 * value

    assert beside(worked, values()) == [10, 20]

    def broken() -> Iterator[int]:
        yield 1
        raise ValueError("diverges")

    with pytest.raises(ValueError, match="diverges"):
        beside(worked, broken())
