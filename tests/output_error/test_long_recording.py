"""A long experiment without an encoder: from its beginning on, by pieces, to the parameters of the rig."""

import numpy as np
import pytest
from small_experiments import forced

import estimators as est
from estimators.core import piecewise_triangle
from estimators.core.data import Data
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.output_error import horizons as module
from estimators.output_error.horizons import horizons
from rtac_jax import RTAC, virtual_rig
from rtac_jax.measurement import Recording, from_rest, multisine

SAMPLES, STEP = 20_000, 5e-3


@pytest.fixture(scope="module")
def recording():
    wave = from_rest(multisine(samples=SAMPLES, sample_time=STEP, rms=0.1, band=(0.5, 5.0), seed=1))
    plans = [virtual_rig.Plan("forced", "forced", SAMPLES * STEP, STEP, wave, initial_position=5e-3, initial_angle=0.3)]
    plans += [virtual_rig.Plan("rest", "rest", 2.0, STEP)]
    return virtual_rig.record(virtual_rig.Rig(), plans, seed=1)


@pytest.mark.slow
def test_a_long_experiment_is_fitted_as_the_whole_of_it(recording, monkeypatch, compile_anew):
    model = RTAC.from_rig(recording)
    by_pieces = est.output_error(model, recording, starts=1, progress=False)
    monkeypatch.setattr(module, "FIRST", 10 * SAMPLES)
    monkeypatch.setattr(piecewise_triangle, "LONG", 10 * SAMPLES)
    compile_anew()  # or what is compiled already would run again
    whole = est.output_error(model, recording, starts=1, progress=False)
    for name, parameter in by_pieces.parameters.items():
        other = whole.parameters[name]
        assert abs(parameter.value - other.value) <= 0.05 * max(other.std, 1e-12 * abs(other.value)), name
        assert parameter.std == pytest.approx(other.std, rel=1e-3)
    truth = virtual_rig.Rig().spring_stiffness
    spring = by_pieces.parameters["spring_stiffness"]
    assert abs(spring.value - truth) < 4 * spring.std


def arguments_of(recording):
    moving = [e for e in recording.experiments if e.kind != "rest"]
    model, data = RTAC.from_rig(recording), Data.of(moving)
    space = space_of(model, moving, free=list(model.free))
    white = diagonal_whitener(np.array([1e-5, 1e-2, 1e-3]), data)
    return Arguments(model, data, space, white, no_gain(model, data), 1), space.unconstrained(off_bounds=0.05)


def test_horizons_grow_up_to_all_samples(monkeypatch):
    short = Recording((forced().cut(0, 400),), {"total_mass": 1.23, "arm_inertia": 9.5e-5})
    given, unknowns = arguments_of(short)
    monkeypatch.setattr(module, "FIRST", 64)
    monkeypatch.setattr(module, "factor", lambda *_: np.zeros((1, 2, 2)))
    monkeypatch.setattr(module, "information", lambda *_: Shown([]))
    assert [part.samples for part in horizons(given, unknowns)] == [64, 400]
    monkeypatch.setattr(module, "GROWTH", 2)
    assert [part.samples for part in horizons(given, unknowns)] == [64, 128, 256, 400]
    monkeypatch.setattr(module, "information", lambda *_: Shown(["a mass"]))  # a beginning that leaves something free
    assert [part.samples for part in horizons(given, unknowns)] == [400]
    monkeypatch.setattr(module, "FIRST", 8192)
    assert [part.samples for part in horizons(given, unknowns)] == [400]


class Shown:
    """What a beginning leaves free."""

    def __init__(self, free):
        self.free = free

    def undetermined(self):
        return self.free
