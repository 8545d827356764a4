"""Factors by pieces are those of the whole, whatever the lengths, the effects and the gains; so are fits."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core import piecewise_triangle as module
from estimators.core.data import Data
from estimators.core.initial_state import scales_of, space_of
from estimators.core.jacobian_factor import Arguments, Factors, factor
from estimators.core.piecewise_triangle import piecewise_triangle, worth_cutting
from estimators.core.residual import diagonal_whitener, no_gain, triangle
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Experiment, Recording

NOISE = np.array([1e-5, 1e-2, 1e-3])
LENGTHS = (300, 97, 610)


def recording():
    """Experiments of three lengths and two sample times, one of them with an encoder and a smooth current."""
    random = np.random.default_rng(0)
    made = []
    for number, (length, step) in enumerate(zip(LENGTHS, (5e-3, 2e-3, 5e-3), strict=True)):
        time = step * np.arange(length)
        current = 0.2 * np.sin(9 * time) + 0.1 * random.standard_normal(length)
        position = 5e-3 * np.cos(10.4 * time)
        position[5:9] = np.nan
        angle = {"arm_angle": np.sin(time), "intersample": "bl"} if number == 0 else {}
        made.append(
            Experiment.of(
                f"forced_{number}", kind="forced", sample_time=step, current=current, cart_position=position,
                arm_velocity=3 * np.sin(9 * time), initial_arm_angle=0.3, **angle,
            )
        )  # fmt: skip
    return Recording(tuple(made), {"total_mass": 1.23, "arm_inertia": 9.5e-5})


def model_with(found, *effects, each=()):
    model = RTAC.from_rig(found)
    for effect in effects:
        model = model + CATALOGUE[effect].candidates(scales_of(model, found.experiments))[0]
    return dataclasses.replace(model, per_experiment=frozenset(each))


def factors(model, found, monkeypatch, *, corrected=False, piece=64):
    """Both factors, with pieces so short that every experiment has several and none ends with one."""
    monkeypatch.setattr(module, "PIECE", piece)
    monkeypatch.setattr(module, "LEAST_PIECE", piece)
    monkeypatch.setattr(module, "SIDE_BY_SIDE", 3 * 2 * piece)
    data = Data.of(found.experiments)
    space = space_of(model, found.experiments, free=[n for n in model.free if n not in model.per_experiment])
    assert (space.known is not None) == bool(found.rig_std)
    unknowns = space.unconstrained(off_bounds=0.05)
    gain = None
    if corrected:  # every state by the output that shows it, differently at every sample
        gain = np.zeros((data.room, len(model.states), 3, data.experiments))
        strength = np.random.default_rng(1).uniform(0.05, 0.2, data.room)[:, None]
        for state, output in ((0, 0), (1, 0), (2, 2), (3, 1)):
            gain[:, state, output] = strength
        gain = jnp.asarray(gain)
    options = {"substeps": jnp.asarray(2), "gain": gain}
    whitener = diagonal_whitener(NOISE, data)
    # As arguments, as in a fit: XLA for processors fails to compile what it draws out of a space that is a constant.
    return [
        Factors(*map(np.asarray, eqx.filter_jit(compute)(model, data, space, unknowns, whitener, **options))).joined()
        for compute in (triangle, piecewise_triangle)
    ]


ALONE = {
    "simulated": ((), (), False),
    "predicted": ((), (), True),
    "states of effects": (("flexible_mode", "cubic_spring"), (), False),
    "parameters of each experiment": ((), ("cart_coulomb.level",), False),
}
CASES = [
    pytest.param(("flexible_mode",), ("cart_coulomb.level",), True, id="all of it"),
    *(pytest.param(*case, id=name, marks=pytest.mark.slow) for name, case in ALONE.items()),
]


@pytest.mark.parametrize(("effects", "each", "corrected"), CASES)
def test_the_factor_by_pieces_is_that_of_the_whole(effects, each, corrected, monkeypatch):
    found = recording()
    whole, pieces = factors(model_with(found, *effects, each=each), found, monkeypatch, corrected=corrected)
    assert np.isfinite(whole).all()
    size = np.linalg.norm(whole, axis=1, keepdims=True)
    size[size == 0] = 1.0
    np.testing.assert_allclose(pieces / size, whole / size, atol=1e-11)


@pytest.mark.slow
def test_what_was_measured_of_constants_counts_in_both(monkeypatch):
    found = dataclasses.replace(recording(), rig_std={"arm_inertia": 1e-7})
    model = RTAC.from_rig(found)
    exact = model_with(dataclasses.replace(found, rig_std={}))
    whole, pieces = factors(model, found, monkeypatch)
    size = np.linalg.norm(whole, axis=1, keepdims=True)
    np.testing.assert_allclose(pieces / size, whole / size, atol=1e-11)
    assert whole.shape[-1] == factors(exact, dataclasses.replace(found, rig_std={}), monkeypatch)[0].shape[-1] + 1


def test_a_step_of_a_fit_factors_what_is_long_by_pieces(monkeypatch, compile_anew):
    """XLA's fusion once failed to compile the pieces inside the compiled step."""
    found = recording()
    model, data = model_with(found), Data.of(found.experiments)
    space = space_of(model, found.experiments, free=list(model.free))
    given = Arguments(model, data, space, diagonal_whitener(NOISE, data), no_gain(model, data), 1)
    unknowns = space.unconstrained(off_bounds=0.05)
    whole = np.asarray(factor(unknowns, given))
    for name, value in {"LONG": 1, "PIECE": 64, "LEAST_PIECE": 64, "SIDE_BY_SIDE": 3 * 2 * 64}.items():
        monkeypatch.setattr(module, name, value)
    compile_anew()  # or what is compiled already would run again
    pieces = np.asarray(factor(unknowns, given))
    size = np.linalg.norm(whole, axis=-1, keepdims=True)
    np.testing.assert_allclose(pieces / size, whole / size, atol=1e-11)


def test_what_is_long_is_cut_and_what_looks_along_a_whole_input_is_not():
    found = recording()
    short = Data.of(found.experiments)
    assert not worth_cutting(model_with(found), short)
    time = 1e-3 * np.arange(12_000)
    long = Experiment.of("long", kind="forced", sample_time=1e-3, current=np.sin(time), cart_position=np.sin(time))
    data = Data.of([long])
    assert worth_cutting(model_with(found), data)
    assert not worth_cutting(model_with(found, "input_delay"), data)


def test_a_beginning_is_the_shorter_recording():
    whole = Data.of(recording().experiments)
    part, cut = whole.beginning(100), Data.of([e.cut(0, min(100, e.samples)) for e in recording()])
    assert part.samples == 100
    assert part.room == whole.room
    assert float(part.present.sum()) == float(cut.present.sum())
    np.testing.assert_array_equal(part.present[:100], np.asarray(cut.present)[:100])
