"""The loop over samples whose number the compiler does not know."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core.data import Data
from estimators.prediction_error.innovations import stretches
from rtac_jax import RTAC, Experiment, simulate
from rtac_jax._run import _states
from rtac_jax.excitation import BEYOND
from rtac_jax.time_loop import SHORT, room_for, time_loop


def moved(carry: Any, row: Any) -> tuple[Any, Any]:
    after = 0.9 * carry + row["push"]
    return after, {"before": carry, "after": after, "both": jnp.stack([carry, after])}  # two of one shape


ROWS = {"push": jnp.asarray(np.random.default_rng(1).normal(size=100))}


@pytest.mark.parametrize("samples", [0, 1, 60, 100])
def test_the_first_samples_are_those_of_a_scan(samples):
    last, shown = time_loop(moved, jnp.asarray(2.0), ROWS, room=100, samples=samples)
    expected, rows = jax.lax.scan(moved, jnp.asarray(2.0), {"push": ROWS["push"][:samples]})
    np.testing.assert_allclose(last, expected)
    for name, found in shown.items():
        np.testing.assert_allclose(found[:samples], rows[name])
        assert not np.any(found[samples:])


def test_derivatives_are_those_of_a_scan():
    def end(first: jax.Array, loop: Any) -> jax.Array:
        return loop(first)[1]["both"][:60].sum()

    one = jax.jvp(
        lambda x: end(x, lambda c: time_loop(moved, c, ROWS, room=100, samples=60)), (jnp.asarray(2.0),), (1.0,)
    )
    other = jax.jvp(lambda x: end(x, lambda c: jax.lax.scan(moved, c, ROWS)), (jnp.asarray(2.0),), (1.0,))
    np.testing.assert_allclose(one, other)


def test_there_is_room_for_all_and_few_sizes():
    sizes = [room_for(samples) for samples in range(1, 20_000)]
    for samples, size in enumerate(sizes, start=1):
        assert samples <= size <= (2.0 if samples <= SHORT else 1.42) * max(samples, 64)
    assert len(set(sizes)) < 15
    assert room_for(128) == 128


def recorded(samples: int) -> Experiment:
    return Experiment.of("a", kind="free", sample_time=0.01, cart_position=np.arange(float(samples)))


def test_recordings_of_several_lengths_share_code():
    start = {"a": (0.01, 0.0, 0.3, 1.0)}
    assert room_for(200 + BEYOND) == room_for(230 + BEYOND)
    long = simulate(RTAC.paper(), [recorded(230)], start=start, substeps=2)["a"]
    before = _states.compiled
    short = simulate(RTAC.paper(), [recorded(200)], start=start, substeps=2)["a"]
    assert _states.compiled == before
    assert len(short.cart_position) == 200
    np.testing.assert_array_equal(short.arm_angle, long.arm_angle[:200])


def test_what_is_beyond_the_samples_makes_no_stretch_of_time():
    data = Data.of([recorded(150), recorded(120)])
    assert data.room > data.samples == 150
    assert not np.any(data.present[150:])
    assert len(np.unique(stretches(data))) == 3  # two of 1.5 s, and one of 1.2 s
