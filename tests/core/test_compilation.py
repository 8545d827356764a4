"""Room for compiled code in long studies, code compiled ahead, and work done at once."""

import os
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import rtac_jax as rtac
from estimators.core.compilation import Ahead, make_room
from estimators.core.residual import triangular
from estimators.core.threads import at_once
from rtac_jax.programs import program


def test_compiled_code_is_dropped_where_memory_maps_run_out(tmp_path: Path) -> None:
    traced = []

    @program
    def doubled(x: jax.Array) -> jax.Array:
        traced.append(1)
        return 2 * x

    maps, allowed = tmp_path / "maps", tmp_path / "allowed"
    maps.write_text("a line for each\n" * 60)
    allowed.write_text("100\n")
    doubled(jnp.ones(3))
    assert not make_room(maps, allowed, fraction=0.7)
    doubled(jnp.ones(3))
    assert len(traced) == 1
    assert make_room(maps, allowed)
    doubled(jnp.ones(3))
    assert len(traced) == 2
    assert not make_room(tmp_path / "not Linux", allowed)


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


def test_work_is_done_at_once_and_given_in_order() -> None:
    """The first is done only when the last has begun, or this would wait forever."""
    last = threading.Event()

    def worked(value: int) -> int:
        if value == 2:
            last.set()
        assert last.wait(timeout=60)
        return 10 * value

    assert at_once(worked, [1, 2]) == [10, 20]
    assert at_once(worked, [3]) == [30]
    assert at_once(worked, []) == []


def test_work_within_work_needs_no_more_threads() -> None:
    def inner(_: int) -> int:
        return threading.get_ident()

    outer = at_once(lambda _: (threading.get_ident(), at_once(inner, range(5))), range(3))
    assert all(set(idents) == {own} for own, idents in outer)
    assert threading.get_ident() not in {own for own, _ in outer}


def test_work_that_fails_says_so_and_the_rest_is_left() -> None:
    begun: list[int] = []
    hold = threading.Event()

    def worked(value: int) -> None:
        begun.append(value)
        if value == 0:
            raise ValueError("diverges")
        assert hold.wait(timeout=0.2) is False

    with pytest.raises(ValueError, match="diverges"):
        at_once(worked, range(100))
    assert 0 in begun
    assert len(begun) < 50


def test_what_is_fitted_at_once_factors_one_matrix_after_the_other() -> None:
    """In a batch, LAPACK's calls wait for each other within XLA's threads: two batches at once would do so for ever."""
    rows = jnp.zeros((3, 2000, 4))
    assert set(ranks_factored(triangular, rows)) == {2}
    assert set(ranks_factored(jnp.linalg.qr, rows)) == {3}  # a batch would be seen


def ranks_factored(function: Any, rows: jax.Array) -> list[int]:
    """Ranks of what QR gives wherever a function calls it."""
    shapes = re.findall(r":f\d+\[([\d,]+)\] = qr\[", str(jax.make_jaxpr(function)(rows)))
    return [len(shape.split(",")) for shape in shapes]
