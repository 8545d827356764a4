"""The test of a lagged force by itself, on innovations made by plain NumPy: its level, and what it sees."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.core.data import Data
from estimators.misspecification.lagged_force import DelayedForce, delayed_forces
from estimators.prediction_error.innovations import Innovations
from rtac_jax.measurement import Experiment

SAMPLE_TIME, SAMPLES, COUNT = 0.01, 600, 4
FREQUENCY = 15.0  # of the motion [rad/s]
STIFFNESS = 300.0  # [N/m]
TIME = np.arange(SAMPLES) * SAMPLE_TIME


class Linear(Innovations):
    """Innovations of two outputs that answer to added inputs by known filters, so that what a force adds is known."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.space: Any = SimpleNamespace(known=None, known_std=None, values=np.zeros(0))  # no constant is uncertain
        self.used = np.array([True, False, True])
        self.added: list[tuple[np.ndarray, np.ndarray]] = []

    def answer(self, current: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Whitened samples [direction sample output experiment] that currents and forces add."""
        found = np.zeros((len(current), self.data.room, 3, self.data.experiments))
        found[:, :, 0] = lfilter([0.0, 0.02], [1.0, -0.6], force, axis=1)
        found[:, :, 2] = lfilter([0.0, 3.0], [1.0, -0.3], current, axis=1)
        return found

    def pushed(self, current: np.ndarray, force: np.ndarray) -> np.ndarray:
        self.added.append((current, force))
        return self.rows(self.answer(current, force))


def experiments(*, current: bool = True, velocity: bool = True, later: float = 0.0) -> list[Experiment]:
    """Forced records of a cart and an arm whose motion has many frequencies; after the middle it may be another one."""
    found = []
    for n in range(COUNT):
        random = np.random.default_rng(n)
        phases = random.uniform(0, 2 * np.pi, (3, 12))
        lines = np.sin(np.linspace(3.0, 60.0, 12) * TIME[:, None] + phases[:, None]).sum(axis=2) / 4
        lines[:, SAMPLES // 2 :] += later
        channels = {"cart_position": 1e-3 * lines[0]}
        channels |= {"arm_velocity": 2.0 * lines[1]} if velocity else {}
        channels |= {"current" if current else "disturbance_force": 0.1 * lines[2]}
        found.append(Experiment.of(f"forced_{n}", kind="forced", sample_time=SAMPLE_TIME, **channels))
    return found


def noise(random: np.random.Generator, linear: Linear, colour: float = 0.0) -> np.ndarray:
    """Rows of unit variance, first-order coloured in time."""
    drawn = random.normal(size=(1, SAMPLES + 200, 3, COUNT))
    return linear.rows(lfilter([np.sqrt(1 - colour**2)], [1, -colour], drawn, axis=1)[:, 200:])[:, 0]


def found(linear: Linear, error: np.ndarray, several: list[Experiment]) -> dict[str, DelayedForce]:
    basis = np.zeros((len(error), 0))
    forces = delayed_forces(linear, error, basis, several, frequency=FREQUENCY, stiffness=STIFFNESS)
    assert [f.excess for f in forces] == sorted((f.excess for f in forces), reverse=True)
    return {f.follows: f for f in forces}


@pytest.mark.parametrize("colour", [0.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_of_noise_alone_it_keeps_its_level(colour: float) -> None:
    """Also where the noise is coloured, of which the model knows nothing."""
    several, random = experiments(), np.random.default_rng(1)
    linear = Linear(Data.of(several))
    p = {"cart_position": [], "arm_velocity": [], "current": []}
    for _ in range(150):
        for follows, force in found(linear, noise(random, linear, colour), several).items():
            p[follows].append(force.p_value)
    for values in p.values():
        assert len(values) == 150
        assert np.mean(np.array(values) < 0.01) < 0.04
        if colour == 0.0:
            assert np.mean(np.array(values) < 0.2) > 0.08  # it does reject


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.parametrize("share", [0.1, 1.0])
@pytest.mark.parametrize("follows", ["cart_position", "arm_velocity", "current"])
def test_a_force_that_lags_is_found_at_the_signal_that_it_follows(follows: str, share: float, settled: bool) -> None:
    """With a lag, as a fraction of the period, that is none of those it tries; the size is that of what it adds.

    The forces that it tries begin as if their signal had stood still before; one that builds up from nothing is found, too, but
    not all of it.
    """
    several, random = experiments(), np.random.default_rng(2)
    linear = Linear(Data.of(several))
    keep = np.exp(-SAMPLE_TIME / (share * 2 * np.pi / FREQUENCY))
    signals = [(e.inputs if follows == "current" else e.outputs)[follows].values for e in several]
    lagged = np.zeros((1, linear.data.room, COUNT))
    before = [[keep * s[0] * settled] for s in signals]
    lagged[0, :SAMPLES] = np.stack(
        [lfilter([1 - keep], [1, -keep], s, zi=b)[0] for s, b in zip(signals, before, strict=True)], axis=1
    )
    nothing = np.zeros_like(lagged)
    added = linear.rows(linear.answer(*((nothing, lagged) if follows == "cart_position" else (lagged, nothing))))[:, 0]
    added *= 20.0 / np.linalg.norm(added)  # 400 in twice the log-likelihood
    explained = []
    for _ in range(5):
        forces = found(linear, noise(random, linear) + added, several)
        assert max(forces.values(), key=lambda f: f.excess).follows == follows
        assert forces[follows].port == ("cart" if follows == "cart_position" else "arm")
        assert forces[follows].p_value < 1e-4
        explained.append(forces[follows].excess / 400.0)
    if settled:
        assert np.mean(explained) == pytest.approx(1.0, abs=0.15)


def test_a_force_depends_on_the_past_only() -> None:
    """Or innovations would depend on it by their own noise, with nothing missing."""
    before, after = (Linear(Data.of(several)) for several in (experiments(), experiments(later=0.5)))
    for linear, several in ((before, experiments()), (after, experiments(later=0.5))):
        found(linear, noise(np.random.default_rng(3), linear), several)
    half = SAMPLES // 2
    by_port = [sorted(linear.added, key=lambda pair: np.any(pair[1])) for linear in (before, after)]
    cart = [added[-1][1] for added in by_port]
    np.testing.assert_array_equal(cart[0][:, :half], cart[1][:, :half])
    assert np.max(np.abs(cart[0][:, half:SAMPLES] - cart[1][:, half:SAMPLES])) > 0.01


def test_what_was_not_recorded_is_not_tested() -> None:
    several = experiments(current=False, velocity=False)
    linear = Linear(Data.of(several))
    assert set(found(linear, noise(np.random.default_rng(4), linear), several)) == {"cart_position"}
