"""A few experiments run the code of four or eight, and give what they give alone."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import rtac_jax as rtac
from estimators.core import jacobian_factor, padded_experiments
from estimators.core.data import CHANNELS, Data
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, Passes, plain_residual
from estimators.core.padded_experiments import experiments_at, padded_places
from estimators.core.parameter_space import Space
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.prediction_error import filter_pass, innovations
from estimators.prediction_error.filter_pass import run_filter, score_noise
from estimators.prediction_error.innovations import Innovations
from estimators.prediction_error.noise_estimation import first_noise
from estimators.prediction_error.noise_model import NoiseModel, start_variance
from rtac_jax import virtual_rig

SCALES = {"cart_position": 1e-5, "arm_velocity": 1e-2, "arm_angle": 1e-3}


class Problem:
    """The first experiments of a recording whose constants are uncertain, with a parameter that each has for itself."""

    def __init__(self, recording: rtac.Recording, count: int) -> None:
        experiments = recording.experiments[:count]
        model = rtac.RTAC.from_rig(recording).each_experiment("cart_coulomb.level")
        self.data = Data.of(experiments)
        self.space: Space = space_of(model, experiments, free=[n for n in model.free if n not in model.per_experiment])
        at = self.space.unconstrained()
        off = 0.1 * np.random.default_rng(1).normal(size=at.start.shape)
        self.model, self.unknowns = model, at._replace(start=at.start + off)
        whitener = diagonal_whitener(np.ones(len(CHANNELS)), self.data)
        self.arguments = Arguments(model, self.data, self.space, whitener, no_gain(model, self.data), 1)
        sensor = np.array([SCALES.get(c, 1.0) for c in CHANNELS])
        self.noise = NoiseModel(sensor, np.ones(len(CHANNELS)), 1.0, 1e-3, 0.01, start_variance(self.space))

    def simulated(self) -> dict[str, Any]:
        """Return what the programs of a simulation give, which see experiments side by side."""
        factors = Passes(self.arguments).factors(self.unknowns)
        error, known = plain_residual(self.unknowns, self.arguments)
        return {
            # Their products do not depend on how the rows were factored.
            "factors": np.swapaxes(factors.channels, -1, -2) @ factors.channels,
            "prior": np.swapaxes(factors.prior, -1, -2) @ factors.prior,
            "error": error,
            "known": known,
        }

    def everything(self) -> dict[str, Any]:
        """Return the same, and what the programs of a filter and of its innovations give."""
        physical = self.space.physical(self.unknowns)
        given = (self.model, self.data, self.space, physical, self.noise)
        passed = score_noise(*given, first_noise(), jnp.asarray(1))
        alone = run_filter(*given, first_noise(), jnp.asarray(1))
        likelihood = filter_pass.negative_log_likelihood(*given, first_noise(), jnp.asarray(1))
        probed = Innovations(
            self.model, self.data, self.space, passed.filtered.whitener, passed.filtered.gain, jnp.asarray(1)
        )
        force = np.random.default_rng(2).normal(size=(3, self.data.room, self.data.experiments))
        return {
            **self.simulated(),
            **{f"filter {name}": rows for name, rows in passed.filtered._asdict().items()},
            "gain alone": alone.gain,
            "value": np.array([passed.value, likelihood]),
            "slope": passed.slope(),
            "curvature": passed.curvature().information,
            "innovations": probed.at(np.asarray(self.space.values)[None]),
            "jacobian": probed.jacobian(),
            "pushed": probed.pushed(1e-2 * force, force),
        }


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=3, duration=0.5, free=3, forced=3)
    found = virtual_rig.record(virtual_rig.Rig(), plans, seed=3)
    return dataclasses.replace(found, rig_std={"arm_inertia": 1e-7})


@pytest.mark.parametrize("of", [Problem.simulated, pytest.param(Problem.everything, marks=pytest.mark.slow)])
def test_each_counts_once(
    recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch, of: Callable[[Problem], dict[str, Any]]
) -> None:
    found = of(Problem(recording, 3))
    monkeypatch.setattr(padded_experiments, "_FEW", 0)
    expected = of(Problem(recording, 3))
    for name, there in expected.items():
        assert np.shape(found[name]) == np.shape(there), name
        scale = np.max(np.abs(there))
        assert scale > 0 or name == "filter shaken"
        np.testing.assert_allclose(found[name], there, atol=1e-9 * scale, rtol=1e-7, err_msg=name)


@pytest.mark.slow
def test_five_and_six_run_the_same_code(recording: rtac.Recording) -> None:
    first = Problem(recording, 5)
    assert np.array_equal(padded_places(first.data), [0, 1, 2, 3, 4, 4, 4, 4])
    programs = [jacobian_factor._factors, jacobian_factor._residual, filter_pass._filter, innovations._innovations]
    programs += [innovations._derivatives, filter_pass._slope, filter_pass._information]
    first.everything()
    before = [program.compiled for program in programs]
    Problem(recording, 6).everything()
    assert [program.compiled for program in programs] == before
    assert min(before) > 0


def test_nothing_is_padded_where_it_would_cost_time(recording: rtac.Recording) -> None:
    data = Problem(recording, 3).data
    assert padded_places(data) is not None
    assert padded_places(Data.of(recording.experiments[:4])) is None
    assert padded_places(experiments_at(data, np.zeros(9, int))) is None
    long = rtac.Experiment.of("long", kind="free", sample_time=0.001, cart_position=np.arange(5000.0))
    assert padded_places(Data.of([long] * 3)) is None
