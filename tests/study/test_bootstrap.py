"""Intervals from replicates beside those that a fit states."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.study import StorageError
from rtac_jax import virtual_rig

PLANS = virtual_rig.standard_plans(seed=1, duration=2.0, free=2, forced=0, rest=1)


def fitted(**changes):
    rig = dataclasses.replace(virtual_rig.Rig(), quantisation_bits=None, **changes)
    recording = virtual_rig.record(rig, PLANS, seed=2)
    model = rtac.RTAC.from_rig(recording).fix("arm_viscous.positive", "arm_viscous.negative", "eccentric_moment")
    return est.output_error(model, recording, from_model=True, progress=False), recording


@pytest.fixture(scope="module")
def white():
    return fitted()


@pytest.mark.slow
def test_the_parametric_bootstrap_agrees_with_cramer_and_rao(white, tmp_path):
    fit, recording = white
    found = est.bootstrap(fit, recording, repetitions=60, seed=3, out=tmp_path, progress=False)
    for name, std in found.std.items():
        # The standard deviation of a standard deviation from 60 normal numbers is 9 %; three of them and what is not linear.
        assert std == pytest.approx(fit.parameters[name].std, rel=0.35)
        low, high = found.interval()[name]
        assert low < fit.parameters[name].value < high
        assert high - low == pytest.approx(2 * 1.96 * std, rel=0.35)
        assert abs(found.bias[name]) < std
    assert "60 replicates, parametric." in str(found)
    again = est.bootstrap(fit, recording, repetitions=60, seed=3, out=tmp_path, progress=False)
    assert again.samples.tobytes() == found.samples.tobytes()
    with pytest.raises(StorageError, match="holds results of another study"):
        est.bootstrap(fit, recording, repetitions=60, seed=4, out=tmp_path, progress=False)


def test_what_was_not_fitted_is_left_out(white):
    fit, recording = white
    more = virtual_rig.record(virtual_rig.Rig(), [dataclasses.replace(PLANS[0], name="later")], seed=5)
    found = est.bootstrap(fit, rtac.Recording.join(recording, more), repetitions=2, seed=3, progress=False)
    np.testing.assert_array_equal(
        found.samples, est.bootstrap(fit, recording, repetitions=2, seed=3, progress=False).samples
    )


@pytest.mark.slow
def test_constants_are_weighed_again_for_each_replicate():
    std = 2e-3  # of 1.23 kg, far more than the decays say of it
    recording = virtual_rig.record(virtual_rig.Rig(), PLANS, seed=2, constants_std={"total_mass": std})
    model = rtac.RTAC.from_rig(recording).fix("arm_viscous.positive", "arm_viscous.negative", "eccentric_moment")
    fit = est.output_error(model, recording, from_model=True, progress=False)
    found = est.bootstrap(fit, recording, repetitions=40, seed=3, progress=False)
    for name in ("total_mass", "spring_stiffness"):  # the scale of all forces is that of the weighing
        assert found.std[name] == pytest.approx(fit.parameters[name].std, rel=0.4)
    assert found.std["total_mass"] == pytest.approx(std, rel=0.4)


@pytest.mark.slow
def test_blocks_see_a_coloured_residual_that_cramer_and_rao_do_not():
    fit, recording = fitted(noise_correlation=0.9)
    blocks = est.bootstrap(fit, recording, repetitions=24, method="blocks", progress=False)
    plain = est.bootstrap(fit, recording, repetitions=24, progress=False)
    stated = np.array([fit.parameters[name].std for name in blocks.names])
    # Noise that remembers ten samples makes slow parameters more uncertain than white noise of the same size.
    assert np.all(np.array(list(blocks.std.values())) > 1.5 * stated)
    assert np.all(np.array(list(plain.std.values())) < 1.5 * stated)


def test_what_cannot_be_drawn_is_refused(white):
    fit, recording = white
    with pytest.raises(ValueError, match="give the recording that was fitted"):
        est.bootstrap(fit, virtual_rig.record(virtual_rig.Rig(), PLANS, seed=9), progress=False)
    for options, words in (
        ({"method": "jackknife"}, "use 'parametric'"),
        ({"repetitions": 1}, "at least 2"),
        ({"block": 0}, "block is 0"),
    ):
        with pytest.raises(ValueError, match=words):
            est.bootstrap(fit, recording, progress=False, **options)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 2e-3])
def test_the_interval_of_a_level_that_may_be_nothing_keeps_to_its_bound(level):
    """A cart with dry friction or without, of which the fit knows nothing: without, half of all estimates lie on the bound."""
    plans = [virtual_rig.Plan("free_1", "free", 4.0, 0.01, initial_position=2e-3, initial_angle=np.pi / 2)]
    rig = virtual_rig.Rig(cart_coulomb=level)
    recording = virtual_rig.record(rig, [*plans, virtual_rig.Plan("rest_1", "rest", 1.0, 0.01)], seed=4)
    model = rtac.RTAC.from_rig(recording)
    asked = ("cart_coulomb.level", "spring_stiffness", "cart_viscous.coefficient")
    model = model.fix(*[n for n in model.free if n not in asked]).with_values({"cart_coulomb.level": 1e-3})
    found = est.bootstrap(
        est.output_error(model, recording, from_model=True, progress=False),
        recording,
        repetitions=40,
        seed=1,
        progress=False,
    )
    low, high = found.interval()["cart_coulomb.level"]
    assert 0.0 <= low <= level <= high
    assert ("cart_coulomb.level" in found.bounded) == (level == 0.0)
    assert ("which may lie on a bound" in str(found)) == (level == 0.0)
