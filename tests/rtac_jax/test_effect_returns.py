"""An effect of the user's own that returns too little is named, before anything is computed with it."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from rtac_jax import RTAC, Experiment, parameter, simulate
from rtac_jax.effects import Force

DECAY = Experiment.of("free", kind="free", sample_time=0.005, cart_position=0.01 * np.cos(0.05 * np.arange(20)))


class Magnet(Force):
    """What is right about it."""

    id: ClassVar[str] = "magnet"
    equation: ClassVar[str] = "-k q"
    source: ClassVar[str] = "own rig"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"
    strength: Any = parameter(symbol="k", unit="N/m", meaning="pull of the magnet", null=0.0, plausible=0.1)

    def force(self, motion, own):
        return -self.strength * motion.cart_position, 0.0


class Stack(Magnet):
    """Its force is one array of two rows, which Python would take apart without a word."""

    def force(self, motion, own):
        return jnp.stack([-self.strength * motion.cart_position, 0.0 * motion.arm_angle])


class Alone(Magnet):
    """Its force is on the cart alone."""

    def force(self, motion, own):
        return (-self.strength * motion.cart_position,)


class Forgetful(Magnet):
    """It has a state and no rate for it."""

    states: ClassVar[dict[str, str]] = {"stretch": "m"}

    def start(self, motion):
        return (motion.cart_position,)

    def rate(self, motion, own):
        return ()


class Counter(Magnet):
    """Its rate is a whole number, or one of single precision."""

    states: ClassVar[dict[str, str]] = {"count": "m"}
    step: ClassVar[Any] = 1.0

    def start(self, motion):
        return (0.0 * motion.cart_position,)

    def rate(self, motion, own):
        return (self.step,)

    def force(self, motion, own):
        return -self.strength * own[0], 0.0


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (Stack(0.2), "magnet: force returns one .*; return a tuple of 2: on the cart, on the arm"),
        (Alone(0.2), "magnet: force returns 1 value\\(s\\); return a tuple of 2: on the cart, on the arm"),
        (Forgetful(0.2), "magnet: rate returns 0 value\\(s\\); return a tuple of 1: stretch"),
    ],
)
def test_an_effect_that_returns_too_little_is_named(effect, said):
    with pytest.raises(ValueError, match=said):
        simulate(RTAC.paper() + effect, [DECAY], start={"free": [0.01, 0.0, 0.0, 0.0]}, substeps=1)


def test_two_values_are_enough():
    run = simulate(RTAC.paper() + Magnet(0.2), [DECAY], start={"free": [0.01, 0.0, 0.0, 0.0]}, substeps=1)
    assert np.all(np.isfinite(np.asarray(run["free"].cart_position)))


class Whole(Counter):
    """It counts by whole numbers."""

    step: ClassVar[Any] = 1


class Short(Counter):
    """It counts in single precision."""

    step: ClassVar[Any] = np.float32(1.0)


@pytest.mark.parametrize("counter", [Whole, Short])
def test_rates_of_other_types_are_numbers_too(counter):
    start = {"free": [0.01, 0.0, 0.0, 0.0]}
    found, exact = (
        simulate(RTAC.paper() + one(0.2), [DECAY], start=start, substeps=1)["free"] for one in (counter, Counter)
    )
    np.testing.assert_array_equal(found.cart_position, exact.cart_position)
    assert np.ptp(np.asarray(exact.states["magnet.count"])) > 0.05
