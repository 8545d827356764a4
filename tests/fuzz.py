"""What every trial of the fuzzing suite keeps to, and how trials are drawn: seeded, none kept between runs."""

import contextlib
import faulthandler
import linecache
import math
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).parents[1]
OURS = tuple(str(ROOT / package) for package in ("rtac_jax", "estimators"))
# What the command line turns into one sentence and an exit status; test_refusals.py holds it to that.
REFUSALS = (ValueError, ArithmeticError, OSError)
# Words of the libraries underneath, which tell a user nothing.
JARGON = re.compile(r"Traceback|Tracer|<class|object at 0x|dtype\('|jaxtyping|beartype|broadcast|leaf_type")
HANG = 120  # s; the longest trial takes a few


def sizes(small, large):
    """A test with few trials in `make test` and with many in `make test-slow`."""
    many = pytest.param(large, id="large", marks=pytest.mark.slow)
    return pytest.mark.parametrize("trials", [pytest.param(small, id="small"), many])


def fuzz(trials, **strategies):
    """Run a function once for each of so many draws, the same draws every time; it runs when it is called."""

    def decorated(trial):
        chosen = settings(
            max_examples=trials,
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        return chosen(given(**strategies)(trial))

    return decorated


@contextlib.contextmanager
def ending():
    """End the process, saying where it stands, when a trial hangs; no signal reaches foreign code."""
    faulthandler.dump_traceback_later(HANG, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def outcome(call, *arguments, **options):
    """What a call returns, or None where it refuses in a sentence of our own; anything else passes through and fails."""
    with ending():
        try:
            return call(*arguments, **options)
        except REFUSALS as error:
            require_sentence(error)
            return None


def require_sentence(error):
    """A refusal is raised by this package itself, in one line that ends as a sentence does."""
    said = str(error)
    trace = error.__traceback__
    while trace.tb_next is not None:
        trace = trace.tb_next
    file, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
    place = f"{file}:{line}: {type(error).__name__}: {said}"
    if isinstance(error, OSError) and error.errno is not None:
        return  # the system's own, with the name of the file: the command line adds the mend
    assert file.startswith(OURS), place
    assert linecache.getline(file, line).strip().startswith("raise"), place
    assert said.endswith("."), place
    assert "\n" not in said, place
    assert not JARGON.search(said), place


def printable(least=0, most=12):
    """Text of any script, without half characters, which no file holds."""
    return st.text(st.characters(exclude_categories=("Cs",)), min_size=least, max_size=most)


# Names as people and programs give them, and as nobody should.
NAMES = st.one_of(
    st.sampled_from(
        ["free_1", "größe", "a b", "../up", "a/b", ".", "..", "", "\0", "x\ny", "$x_1$", "<script>", "con", "[0:9]", "n" * 400, "|"]
    ),
    printable(),
)  # fmt: skip
NUMBERS = st.one_of(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, 5e-324, 1e15, 1e-15, math.inf, -math.inf, math.nan]),
    st.floats(),
    st.integers(-(2**70), 2**70),
)
# What stands where a number should.
ODD = st.one_of(NUMBERS, st.sampled_from([None, "1", "1 kg", b"1", True, (), [1.0], {}, 1j]), printable())
