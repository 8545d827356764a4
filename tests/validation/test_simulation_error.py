"""A model beside measurements: what its residuals say, and where its simulation begins."""

import dataclasses

import control
import jax.numpy as jnp
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.data import Data, moving
from estimators.core.initial_rest import at_rest, best_starts, squares
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, _factors, _residual
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.core.results import DivergedError
from estimators.validation import simulation_error
from estimators.validation.simulation_error import Trace
from rtac_jax import virtual_rig
from rtac_jax.effects import SplineForce

STIFFNESS, DAMPING, ROTOR = 0.3, 2e-5, 0.3  # of a soft shaft; the last is what the motor has of the arm's inertia


def test_residual_statistics_of_a_trace() -> None:
    random = np.random.default_rng(2)
    time = 0.01 * np.arange(2000)
    clean = np.sin(time)
    white = Trace("a", "cart_position", time, clean + 0.1 * random.normal(size=2000), clean, clean, time >= 0, 0.1)
    assert white.rms == pytest.approx(0.1, rel=0.1)
    assert white.fit_percent == pytest.approx(100 * (1 - white.rms / np.std(white.measured)), rel=1e-9)
    assert white.whiteness_p > 0.01
    assert np.mean(np.abs(white.autocorrelation()[0][1:]) < white.autocorrelation()[1]) > 0.9
    coloured = control.forced_response(control.tf([1], [0.05, 1]), time, random.normal(size=2000)).outputs
    stained = Trace("a", "cart_position", time, clean + coloured, clean, clean, time >= 0, 0.1)
    assert stained.whiteness_p < 1e-6


def test_all_experiments_count_the_samples_that_each_counts() -> None:
    """A decay whose first samples only set the start, and whose mean over them is another."""
    time = 0.01 * np.arange(2000)
    decay = np.exp(-time) + 0.1 * np.sin(20 * time)
    traces = tuple(
        Trace(name, "cart_position", time, decay, 0.9 * decay, decay, time >= begin, 0.1)
        for name, begin in (("a", 2.0), ("b", 5.0))
    )
    for own in (traces[:1], traces[1:]):
        compared = simulation_error.Compared("m", rtac.RTAC.paper(), own, {}, {})
        assert compared.errors["cart_position"].fit_percent == pytest.approx(own[0].fit_percent, rel=1e-12)
    both = simulation_error.Compared("m", rtac.RTAC.paper(), traces, {}, {}).errors["cart_position"]
    used = [decay[time >= begin] for begin in (2.0, 5.0)]
    left = np.sqrt(sum(np.sum((0.1 * y) ** 2) for y in used) / sum(np.sum((y - np.mean(y)) ** 2) for y in used))
    assert both.fit_percent == pytest.approx(100 * (1 - left), rel=1e-9)


def test_each_experiment_is_held_against_the_noise_that_is_stated_of_it() -> None:
    """One is ten times noisier: against one level for both, the quiet one lies far below its noise."""
    quiet, loud = (
        virtual_rig.record(
            virtual_rig.Rig(position_noise=level),
            [virtual_rig.Plan(name, "free", 4.0, 0.01, initial_position=8e-3, initial_angle=np.pi / 2)],
            seed=seed,
        ).experiments[0]
        for name, level, seed in (("quiet", 2e-5, 1), ("loud", 2e-4, 2))
    )
    recording = rtac.Recording(
        tuple(
            dataclasses.replace(
                e, outputs={"cart_position": dataclasses.replace(e.outputs["cart_position"], noise_std=level)}
            )
            for e, level in ((quiet, 2e-5), (loud, 2e-4))
        ),
        rig={"total_mass": virtual_rig.Rig().total_mass},
    )
    found = est.compare(rtac.RTAC.paper(), recording).models[0]
    for trace in found.traces:
        assert trace.rms / trace.noise == pytest.approx(1.0, abs=0.15), trace.experiment
    assert found.errors["cart_position"].rms_over_noise == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_simulation_begins_at_a_speed_of_the_arm_that_no_sample_shows() -> None:
    """The tachometer sits on the rotor, which swings by radians per second about an arm behind a soft shaft."""
    rig = dataclasses.replace(virtual_rig.Rig(), shaft_stiffness=STIFFNESS, shaft_damping=DAMPING, rotor_share=ROTOR)
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.002, duration=5.0, free=0, forced=4, rest=1)
    recording = virtual_rig.record(rig, plans, seed=4)
    twist = np.sqrt(STIFFNESS / (rig.arm_inertia * ROTOR * (1 - ROTOR)))
    damping = 0.5 * DAMPING * twist / STIFFNESS
    shaft = rtac.effects.FlexibleShaft(rig.arm_inertia / STIFFNESS, ROTOR, damping, 0.9 / 0.002)
    for trace in est.compare(rtac.RTAC.paper() + shaft, recording).models[0].traces:
        assert trace.rms < 1.2 * trace.noise, (trace.experiment, trace.channel)


def test_of_several_starts_each_experiment_takes_the_one_that_leaves_least() -> None:
    """Two decays from rest; the first is told a speed that it does not have, the second is not."""
    plans = virtual_rig.standard_plans(seed=5, sample_time=0.01, duration=3.0, free=2, forced=0, rest=1)
    experiments = moving(virtual_rig.record(virtual_rig.Rig(), plans, seed=6))
    model, data = rtac.RTAC.paper(), Data.of(experiments)
    space = space_of(model, experiments, free=[])
    start = np.asarray(space.start).copy()
    start[3] = 5.0, 0.0
    space = dataclasses.replace(space, start=jnp.asarray(start))
    whitener, nothing = diagonal_whitener(np.array([2e-5, 1e-3, 0.05]), data), no_gain(model, data)
    arguments = Arguments(model, data, space, whitener, nothing, 1)
    told = space.unconstrained()
    rest = at_rest(told, space)
    assert np.max(np.abs(np.asarray(space.physical(rest)[2])[[1, 3]])) < 1e-12
    best = best_starts([told, rest], arguments)
    assert np.all(squares(best, arguments) == np.minimum(squares(told, arguments), squares(rest, arguments)))
    assert squares(best, arguments)[0] < 0.01 * squares(told, arguments)[0]
    # One that is a little better is not worth a change, nor is one that diverges.
    assert best_starts([told, rest], arguments, worth=1e-6) is told
    lost = told._replace(start=told.start.at[0].set(np.nan))
    assert best_starts([told, lost], arguments) is told


@pytest.mark.slow
def test_fewer_experiments_than_were_fitted_need_no_other_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are simulated over and over, and come out as they do alone."""
    plans = virtual_rig.standard_plans(seed=5, sample_time=0.01, duration=3.0, free=2, forced=3, rest=1)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=6)
    train, held_out = recording.split(["free_2", "forced_3"])
    # What other tests compiled would serve here too, and both counts below would stay as they are.
    _factors.forget()
    _residual.forget()
    fit = est.output_error(rtac.RTAC.from_rig(recording), train, progress=False)
    before = _factors.compiled, _residual.compiled
    found = est.compare(fit, held_out).models[0]
    assert (_factors.compiled, _residual.compiled) == before
    monkeypatch.setattr(simulation_error, "_OVER", 0)
    alone = est.compare(fit, held_out).models[0]
    assert (_factors.compiled, _residual.compiled) != before
    assert [trace.experiment for trace in found.traces] == [trace.experiment for trace in alone.traces]
    for one, other in zip(found.traces, alone.traces, strict=True):
        np.testing.assert_allclose(one.simulated, other.simulated, atol=1e-3 * one.noise)
    for name, start in alone.start.items():
        np.testing.assert_allclose(found.start[name], start, atol=1e-3)


@pytest.fixture(scope="module")
def swings() -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=7, sample_time=0.01, duration=4.0, free=1, forced=1, rest=1)
    return virtual_rig.record(virtual_rig.Rig(), plans, seed=8)


@pytest.mark.parametrize(
    "variable",
    [
        "cart_position",
        "arm_velocity",
        *(
            pytest.param(v, marks=pytest.mark.slow)
            for v in ("cart_velocity", "current", "cart_position, against the motion")
        ),
    ],
)
def test_it_says_where_a_learned_force_leaves_its_range(swings: rtac.Recording, variable: str) -> None:
    """A range of half of what was recorded, and one a fifth wider than nearly all of it; the share is read off the measurements."""
    name = variable.split(",")[0]
    forced = next(e for e in swings if e.kind == "forced")
    position = np.asarray(forced.outputs["cart_position"].values)
    recorded = {
        "cart_position": position,
        "cart_velocity": np.gradient(position, forced.sample_time),
        "arm_velocity": np.asarray(forced.outputs["arm_velocity"].values),
        "current": np.asarray(forced.inputs["current"].values),
    }[name]
    far = 0.5 * float(np.max(np.abs(recorded)))
    low, high = np.quantile(recorded, [0.001, 0.999])
    port = "arm" if name.startswith("arm") else "cart"
    half, whole = (
        est.compare(rtac.RTAC.paper() + SplineForce.over(variable, between, port=port), swings)
        for between in ((-far, far), (min(1.2 * low, 0.0), max(1.2 * high, 0.0)))
    )
    told, share = half.models[0].beyond["forced_1"]
    assert told == name
    assert share == pytest.approx(np.mean(np.abs(recorded) > far), abs=0.03)
    assert f"of forced_1 {name} lies beyond the range of the learned force" in str(half)
    assert "forced_1" not in whole.models[0].beyond
    assert f"of forced_1 {name}" not in str(whole)


def test_a_model_that_diverges_is_held_where_that_is_asked() -> None:
    """As the first model of a loop may, in an experiment that it was not fitted to: an inverted spring runs away."""
    plans = virtual_rig.standard_plans(seed=5, duration=3.0, free=1, forced=1, rest=0)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=6)
    wrong = rtac.RTAC.from_rig(recording).with_values({"spring_stiffness": -1e6})
    with pytest.raises(DivergedError, match="diverges"):
        est.compare(wrong, recording)
    found = est.compare(
        [rtac.RTAC.from_rig(recording), wrong], recording, labels=["right", "wrong"], hold_diverging=True
    )
    right, held = found.models
    assert not right.diverging
    assert set(held.diverging) == {trace.experiment for trace in held.traces}
    for trace in held.traces:
        assert np.max(np.abs(trace.simulated)) <= 10.0 * np.max(np.abs(trace.measured)) * (1 + 1e-12)
    assert all(held.errors[c].rms > right.errors[c].rms for c in held.errors)
    assert "A model diverges (wrong after" in found.divergence
    assert found.divergence in str(found)
