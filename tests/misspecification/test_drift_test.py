"""The test of drift by itself, on innovations made by plain NumPy: its level, and the rates that it sees."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.core.data import Data
from estimators.misspecification.drift_test import parameter_drifts
from estimators.misspecification.findings import ParameterDrift
from estimators.prediction_error.innovations import Innovations, orthonormal
from rtac_jax.measurement import Experiment

NAMES = ("spring_stiffness", "held", "cart_viscous")
VALUES, SCALE = np.array([300.0, 1.0, 2.0]), np.array([10.0, 1.0, 0.1])
FREE = [0, 2]


class Linear(Innovations):
    """Innovations with one output, whose derivatives by two parameters are known."""

    def __init__(self, several: list[Experiment]) -> None:
        self.data = Data.of(several)
        space: Any = SimpleNamespace(known=None, known_std=None, values=VALUES, scale=SCALE, names=NAMES)
        space.active = np.array([*FREE, len(NAMES)])  # one place more is an unknown that does nothing
        self.space = space
        self.model: Any = SimpleNamespace(parameters={name: SimpleNamespace(unit="a unit") for name in NAMES})
        self.used = np.array([True, False, False])

    def jacobian(self) -> np.ndarray:
        drawn = np.zeros((3, self.data.room, 3, self.data.experiments))
        drawn[:2, :, 0] = np.random.default_rng(0).normal(size=(2, *drawn.shape[1:2], drawn.shape[3]))
        return self.rows(lfilter([1.0, 0.5], [1.0, -0.9], drawn, axis=1) * np.asarray(self.data.present))


def experiments() -> list[Experiment]:
    """Experiments of other lengths and sample times."""
    return [
        Experiment.of(f"free_{n}", kind="free", sample_time=step, cart_position=np.cos(0.1 * np.arange(count)))
        for n, (step, count) in enumerate([(0.01, 600), (0.005, 1000), (0.01, 900)])
    ]


def seconds(linear: Linear) -> np.ndarray:
    found = np.zeros((1, linear.data.room, 3, linear.data.experiments))
    for column, e in enumerate(experiments()):
        found[0, : len(e.outputs["cart_position"].values), 0, column] = e.sample_time * np.arange(
            len(e.outputs["cart_position"].values)
        )
    return linear.rows(found)[:, 0]


def drifts(linear: Linear, error: np.ndarray) -> dict[str, ParameterDrift]:
    jacobian = linear.jacobian()
    basis = orthonormal(jacobian)
    found = parameter_drifts(linear, jacobian, error - basis @ (basis.T @ error))
    assert [d.excess for d in found] == sorted((d.excess for d in found), reverse=True)
    return {d.parameter: d for d in found}


def noise(random: np.random.Generator, linear: Linear, colour: float = 0.0) -> np.ndarray:
    drawn = random.normal(size=(1, linear.data.room + 200, 3, linear.data.experiments))
    coloured = lfilter([np.sqrt(1 - colour**2)], [1, -colour], drawn, axis=1)[:, 200:]
    return linear.rows(coloured * np.asarray(linear.data.present))[:, 0]


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_of_noise_alone_it_keeps_its_level(colour: float) -> None:
    """Also where the noise is coloured, of which the model knows nothing."""
    linear, random = Linear(experiments()), np.random.default_rng(1)
    p = np.array([
        [d.p_value for d in drifts(linear, noise(random, linear, colour)).values()] for _ in range(200)
    ])  # fmt: skip
    assert np.mean(p < 0.01) < 0.03
    if colour == 0.0:
        assert np.mean(p < 0.2) > 0.08  # it does reject


@pytest.mark.parametrize("place", [0, 1])
def test_the_rate_of_the_parameter_that_drifts_is_found(place: int) -> None:
    """In its own unit a second, with its deviation, whatever the lengths and sample times of the experiments."""
    linear, random = Linear(experiments()), np.random.default_rng(2)
    rate = (4.0, 0.05)[place]
    # An innovation is what was measured less what the model foretells: a parameter that is larger lowers it.
    added = -linear.jacobian()[:, place] / SCALE[FREE[place]] * rate * seconds(linear)
    apart = []
    for _ in range(20):
        found = drifts(linear, noise(random, linear) + added)
        assert list(found) == [NAMES[FREE[place]], NAMES[FREE[1 - place]]]
        first = found[NAMES[FREE[place]]]
        assert first.p_value < 1e-3
        assert first.value == VALUES[FREE[place]]
        assert first.std < 0.1 * rate
        apart.append((first.rate - rate) / first.std)
    assert abs(np.mean(apart)) < 4 / np.sqrt(20)
    assert 0.5 < np.std(apart) < 1.6


def test_what_differs_between_long_and_short_experiments_is_no_drift() -> None:
    """A parameter that is constant in each, and another in the shortest, which ends before the others."""
    linear, random = Linear(experiments()), np.random.default_rng(3)
    brief = seconds(linear) < 0
    brief[len(brief) // 3 : 2 * len(brief) // 3] = True  # the second experiment of three
    added = -linear.jacobian()[:, 0] * 0.3 * brief
    largest = []
    for _ in range(20):
        drawn = noise(random, linear) + added
        largest.append(max(d.excess for d in drifts(linear, drawn).values()))
    assert np.linalg.norm(added) > 20.0  # what is added is far beyond the noise, by itself
    assert max(largest) < 12.0  # of 40 chi-squares of one degree less that; with one set of parameters for all it is 64
