"""Threads for independent work, and those of the libraries of linear algebra beside them."""

import threading

import pytest
import threadpoolctl

from estimators.core.threads import at_once, one_blas_thread


def blas_threads() -> list[int]:
    """Return the number of threads of each library of linear algebra that is loaded."""
    return [one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"]


@pytest.fixture
def two_threads():
    # From 3.8 on the library lets one thread set the number, which may be a thread of another test.
    forget = getattr(threadpoolctl.OpenBLASController, "clear_controlling_thread", lambda **_: None)
    forget(force=True)
    with threadpoolctl.threadpool_limits(2, "blas"):
        if set(blas_threads()) != {2}:
            pytest.skip("no library of linear algebra here takes two threads.")
        yield


def test_the_libraries_keep_to_one_thread_while_anybody_asks_and_get_theirs_back(two_threads):
    """Also where one who asked later lets go later, as threads that fit side by side do."""
    second_in, first_out = threading.Event(), threading.Event()
    seen = []

    def second() -> None:
        with one_blas_thread():
            second_in.set()
            assert first_out.wait(10)
            seen.append(set(blas_threads()))

    with one_blas_thread(), one_blas_thread():
        assert set(blas_threads()) == {1}
        other = threading.Thread(target=second)
        other.start()
        assert second_in.wait(10)
    first_out.set()
    other.join()
    assert seen == [{1}]
    assert set(blas_threads()) == {2}


def test_they_get_theirs_back_where_work_fails(two_threads):
    @one_blas_thread()
    def failing(number: int) -> None:
        raise ArithmeticError(f"{number} of {sorted(set(blas_threads()))}")

    with pytest.raises(ArithmeticError, match=r"of \[1\]"):
        at_once(failing, [1, 2, 3])
    assert set(blas_threads()) == {2}
