"""Experiments of unequal lengths, sample times and channels: each counts as if it stood alone."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_experiments import forced as small_forced

import estimators as est
import rtac_jax as rtac
from estimators.core.data import CHANNELS, Data
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, factor, plain_residual
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.core.step_size import accurate_substeps
from estimators.misspecification.replication_test import repeat_test
from estimators.misspecification.spectral_line_test import spectral_line
from estimators.output_error.correction import _settled
from estimators.prediction_error.ekf import filtered
from estimators.prediction_error.innovations import stretches
from estimators.prediction_error.noise_model import start_variance
from estimators.validation.model_comparison import by_sample
from rtac_jax import virtual_rig

NOISE = np.array([2e-5, 0.05, 2e-3])
STEPS = jnp.asarray(2)
FREE = ["eccentric_moment", "torque_constant", "cart_viscous.coefficient"]


def plans(*, long=4.0, quick=0.001, few=2.0):
    """Two free and three forced runs, the free ones longer, one of these with short steps."""
    found = virtual_rig.standard_plans(seed=1, duration=few, free=2, forced=3)
    return [dataclasses.replace(p, duration=long) if p.kind == "free" else p for p in found if p.name != "free_2"] + [
        dataclasses.replace(p, sample_time=quick) for p in found if p.name == "free_2"
    ]


@pytest.fixture(scope="module")
def recording():
    return virtual_rig.record(virtual_rig.Rig(), plans(), seed=2)


@pytest.fixture(scope="module")
def model(recording):
    return rtac.RTAC.from_rig(recording)


@pytest.fixture(scope="module")
def mixed():
    """One experiment with all three sensors, a short one with the position only, one with the arm's velocity only.

    Of 280 to 467 samples, which by themselves run the same compiled code.
    """
    found = virtual_rig.record(virtual_rig.Rig(encoder=True), plans(long=2.0, quick=0.003, few=1.4), seed=2)
    keep = {
        "free_1": CHANNELS, "free_2": CHANNELS[:1], "forced_1": CHANNELS[1:2], "forced_2": (CHANNELS[0], CHANNELS[2]),
    }  # fmt: skip
    return [
        dataclasses.replace(e, outputs={c: s for c, s in e.outputs.items() if c in keep[e.name]})
        for e in found
        if e.name in keep
    ]


def alone(space, column):
    each = ("each_values", "start", "start_scale", "start_spread", "start_held")
    return dataclasses.replace(space, **{name: getattr(space, name)[:, column : column + 1] for name in each})


def seen(model, data, space):
    """Filter, residual of simulation and prediction, and triangles of both."""
    unknowns = space.unconstrained()
    variance = jnp.broadcast_to(jnp.asarray(NOISE**2)[:, None], (3, data.experiments))
    passed = filtered(
        model, data, space, space.physical(unknowns), sensor_variance=variance, process=(1e-6, 1e-10),
        start_variance=start_variance(space), substeps=STEPS,
    )  # fmt: skip
    arguments = [
        Arguments(model, data, space, diagonal_whitener(NOISE, data), no_gain(model, data), STEPS),
        Arguments(model, data, space, passed.whitener, passed.gain, STEPS),
    ]
    return passed, [(plain_residual(unknowns, a)[0], factor(unknowns, a)) for a in arguments]


def near(one, other):
    one, other = np.asarray(one), np.asarray(other)
    assert np.all(np.isfinite(one))
    np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8 * max(np.max(np.abs(other), initial=0.0), 1e-300))


def products_of(*factors):
    """Return products of the columns of factors, in units of their lengths; triangles differ where columns depend on each other."""
    lengths = np.maximum(np.linalg.norm(factors[0], axis=0), 1e-300)
    return [(factor / lengths).T @ (factor / lengths) for factor in factors]


@pytest.mark.slow
def test_each_experiment_counts_as_if_it_stood_alone(mixed, model):
    space = space_of(model, mixed, free=FREE)
    together, both = seen(model, Data.of(mixed), space)
    for column, e in enumerate(mixed):
        single, each = seen(model, Data.of([e]), alone(space, column))
        part = slice(e.samples)
        for name in ("gain", "whitener", "innovations", "shaken"):
            near(getattr(together, name)[part, ..., column], getattr(single, name)[part, ..., 0])
            if name != "gain":
                assert not np.any(np.asarray(getattr(together, name))[e.samples :, ..., column])
        near(together.log_likelihood[column], single.log_likelihood[0])
        near(by_sample(together)[part, column], by_sample(single)[part, 0])
        for (residual, triangle), (own, factor_of_own) in zip(both, each, strict=True):
            near(residual[part, :, column], own[part, :, 0])
            near(*products_of(triangle[column], factor_of_own[0]))


@pytest.mark.slow
def test_what_would_leave_all_bounds_beyond_the_end_of_an_experiment_does_no_harm(mixed, model):
    model = model.with_values({"spring_stiffness": -2000.0})
    both = [mixed[0], mixed[0].cut(0, 24, "brief")]
    space = space_of(model, both, free=FREE)
    together, (simulated, _) = seen(model, Data.of(both), space)
    assert not np.all(np.isfinite(simulated[0][..., 0]))
    single, (own, _) = seen(model, Data.of(both[1:]), alone(space, 1))
    near(simulated[0][:24, :, 1], own[0][:24, :, 0])
    assert np.all(np.isfinite(np.asarray(simulated[0])[..., 1]))
    near(together.log_likelihood[1], single.log_likelihood[0])


def test_a_typical_whitener_is_that_of_the_samples_there_are(mixed, model):
    space = space_of(model, mixed, free=FREE)
    data = Data.of(mixed)
    typical = _settled(np.asarray(seen(model, data, space)[0].whitener), data)
    for column, e in enumerate(mixed):
        for row, channel in enumerate(CHANNELS):
            assert (typical[0, row, row, column] > 0) == (channel in e.outputs)


def test_an_integration_step_is_short_enough_for_the_few_samples_that_are_far_apart(mixed, model):
    quick = [dataclasses.replace(e, name=f"{e.name}_{n}") for n in range(9) for e in mixed if e.name == "free_2"]
    slow = [e for e in mixed if e.name == "free_1"]

    def substeps(experiments):
        space = space_of(model, experiments, free=["eccentric_moment"])
        return accurate_substeps(model, Data.of(experiments), space, space.unconstrained(), 1e-6 * NOISE)

    assert substeps(quick + slow) >= substeps(slow) > 1


def test_stretches_are_equally_long_in_time(mixed):
    numbers = stretches(Data.of(mixed))
    for column, e in enumerate(mixed):
        several = len(set(numbers[: e.samples, column]))
        assert several == max(round(e.samples * e.sample_time), 1)


def test_a_fit_reaches_the_noise_and_the_truth(recording):
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    for channel, rms in fit.residual_std.items():
        assert 0.85 < rms / fit.noise[channel] < 1.1
    for name in ("eccentric_moment", "spring_stiffness", "torque_constant"):
        truth = getattr(virtual_rig.Rig(), name)
        assert abs(fit.parameters[name].value - truth) < 4.0 * fit.parameters[name].std
    compared = est.compare(fit, recording)
    again = est.compare(fit, rtac.Recording([recording["free_2"]], rig=recording.rig))
    for trace in again.models[0].traces:
        same = [t for t in compared.models[0].traces if (t.experiment, t.channel) == (trace.experiment, trace.channel)]
        near(same[0].simulated, trace.simulated)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [{}, {"cubic_spring": 5e4}])
def test_a_quick_diagnosis_names_what_is_hidden_and_nothing_else(hidden):
    rig = dataclasses.replace(virtual_rig.Rig(), **hidden)
    recording = virtual_rig.record(rig, plans(long=8.0, quick=0.002, few=4.0), seed=2)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, thorough=False, progress=False)
    assert found.verdict == ("missing" if hidden else "adequate")
    assert [c.id for c in found.effects] == list(hidden)


def test_a_vibration_is_found_in_the_few_experiments_that_are_sampled_otherwise():
    random = np.random.default_rng(0)
    experiments = [small_forced(f"forced_{n}") for n in range(3)]
    quick = [small_forced("quick", sample_time=1e-3), small_forced("other", sample_time=4e-3)]
    experiments += quick
    innovations = random.standard_normal((2000, 3, len(experiments)))
    innovations[:, 0, 3] += 0.4 * np.sin(0.7 * np.arange(2000))
    found = spectral_line(innovations, np.ones_like(innovations), experiments)
    assert found is not None
    assert found.p_value < 1e-6
    assert found.frequency == pytest.approx(700.0, rel=0.01)


def test_repeats_that_were_sampled_otherwise_are_not_held_against_each_other():
    first, again = small_forced("first"), small_forced("again", repeat_of="first")
    innovations = np.random.default_rng(0).standard_normal((2000, 3, 2))
    assert repeat_test(innovations, np.ones_like(innovations), [first, again]) is not None
    other = dataclasses.replace(again, sample_time=1e-3)
    assert repeat_test(innovations, np.ones_like(innovations), [first, other]) is None
