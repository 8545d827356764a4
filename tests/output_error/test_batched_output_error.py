"""Many fits at once against one after the other."""

import dataclasses

import numpy as np
import pytest
from exact_decay import TRUTH

import estimators as est
import rtac_jax as rtac
from estimators.core.jacobian_factor import factor, plain_residual
from estimators.core.levenberg_marquardt import solve
from estimators.core.linearisation import at_fit
from estimators.core.residual import diagonal_whitener
from rtac_jax import virtual_rig

FREE = ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level")
Values = np.ndarray


def recorded(**rig: float) -> list[rtac.Recording]:
    """Three decays each, on rigs of different springs."""
    jobs = []
    for number in range(8):
        plans = virtual_rig.standard_plans(seed=5, sample_time=0.01, duration=3.0, free=3, forced=0, rest=1)
        stiffness = TRUTH["spring_stiffness"] * (1 + 0.005 * number)
        jobs.append((virtual_rig.Rig(spring_stiffness=stiffness, **rig), plans, 30 + number))
    return virtual_rig.record_many(jobs)


def freed(recordings: list[rtac.Recording], *names: str) -> rtac.RTAC:
    whole = rtac.RTAC.from_rig(recordings[0])
    return whole.fix(*(set(whole.free) - set(names)))


@pytest.fixture(scope="module")
def recordings() -> list[rtac.Recording]:
    return recorded()


@pytest.fixture(scope="module")
def model(recordings: list[rtac.Recording]) -> rtac.RTAC:
    return freed(recordings, *FREE)


@pytest.fixture(scope="module")
def batch(model: rtac.RTAC, recordings: list[rtac.Recording]) -> est.BatchFit:
    return est.output_error_batch(model, recordings, progress=False)


def at_the_end(fit: est.Fit, recording: rtac.Recording) -> tuple[Values, Values]:
    """Parameters and rms errors of a single fit, led on from where its rougher tolerances end until nothing moves."""
    problem = at_fit(fit, recording)
    arguments, unknowns, noise = problem.arguments, problem.unknowns, np.array(list(fit.noise.values()))
    rms = np.array(list(fit.residual_std.values()))
    for _ in range(3):
        whitener = diagonal_whitener(np.append(rms, 1.0), arguments.data)
        arguments = dataclasses.replace(arguments, whitener=whitener)
        unknowns = solve(unknowns, arguments, tolerance=1e-14, gain=0.0).unknowns
        error, present = np.asarray(plain_residual(unknowns, arguments)[0]), np.asarray(arguments.data.present)
        rms = rms * np.sqrt((error**2).sum(axis=(0, 2)) / present.sum(axis=(0, 2)).clip(1))[: len(noise)]
    shared = np.asarray(arguments.space.physical(unknowns)[0])
    return shared[np.asarray(arguments.space.active)], rms


def start_deviations(fit: est.Fit, recording: rtac.Recording) -> Values:
    """Standard deviations of the states at the start, the parameters given, (state, experiment), SI units."""
    problem = at_fit(fit, recording)
    space, unknowns = problem.arguments.space, problem.unknowns
    own = np.asarray(factor(unknowns, problem.arguments))[..., len(unknowns.shared) : -1]
    deviations = np.sqrt([np.diag(np.linalg.pinv(one.T @ one)) for one in own]).T
    moved = unknowns._replace(start=unknowns.start + deviations)
    return np.abs(np.asarray(space.physical(moved)[2] - space.physical(unknowns)[2]))


@pytest.mark.slow
def test_each_result_is_that_of_a_single_fit() -> None:
    """Without friction that changes where the motion turns, which makes kinks that each way of descending meets elsewhere."""
    recordings = recorded(cart_coulomb=0.0)
    model = freed(recordings, *FREE).without("cart_coulomb").with_values({"arm_viscous.negative": 1.39e-4})
    batch = est.output_error_batch(model, recordings, progress=False)
    assert batch.names == FREE[:2]
    assert np.all(batch.successful)
    for number, recording in enumerate(recordings):
        single = est.output_error(model, recording, from_model=True, progress=False)
        assert single.statistics["substeps"] == batch.substeps
        values, rms = at_the_end(single, recording)
        deviations = np.array([single.parameters[name].std for name in batch.names])
        # Weights and steps of the reference end a millionth from where they would for ever.
        assert np.max(np.abs(batch.values[number] - values) / deviations) < 5e-6
        np.testing.assert_allclose(batch.std[number], deviations, rtol=1e-3)
        np.testing.assert_allclose([one[number] for one in batch.residual_std.values()], rms, rtol=1e-7)
    # The last step is taken and not simulated, where those before it say that it leads near enough.
    early = est.output_error_batch(model, recordings, tolerance=1e-3, progress=False)
    assert np.all(early.successful)
    assert np.median(early.steps) <= 4
    assert np.max(np.abs(early.values - batch.values) / batch.std) < 5e-3
    assert np.median(np.abs(early.values - batch.values) / batch.std) < 1e-3
    np.testing.assert_allclose(early.std, batch.std, rtol=1e-3)


@pytest.mark.slow
def test_with_dry_friction_it_is_so_to_two_hundredths_of_the_deviation(
    model: rtac.RTAC, recordings: list[rtac.Recording], batch: est.BatchFit
) -> None:
    assert batch.names == FREE
    assert np.all(batch.successful)
    for number in (0, 1, 5):
        single = est.output_error(model, recordings[number], from_model=True, progress=False)
        deviations = np.array([single.parameters[name].std for name in FREE])
        values = np.array([single.parameters[name].value for name in FREE])
        assert np.max(np.abs(batch.values[number] - values) / deviations) < 0.02
        np.testing.assert_allclose(batch.std[number], deviations, rtol=1e-2)
        starts = np.stack([single.start[name] for name in batch.experiments], axis=-1)
        assert np.max(np.abs(batch.start[number] - starts) / start_deviations(single, recordings[number])) < 0.02


def test_the_truth_lies_within_the_deviations(batch: est.BatchFit) -> None:
    truth = np.tile([TRUTH[name] for name in FREE], (8, 1))
    truth[:, 0] *= 1 + 0.005 * np.arange(8)
    deviations = (batch.values - truth) / batch.std
    assert np.max(np.abs(deviations)) < 4.0
    assert 0.5 < np.sqrt(np.mean(deviations**2)) < 1.6


def test_one_that_diverges_is_said_and_leaves_the_others_alone(
    model: rtac.RTAC, recordings: list[rtac.Recording], batch: est.BatchFit
) -> None:
    # A step of 10 ms cannot follow a spring this stiff; and a start that is no number is none.
    stiffness = np.full(8, TRUTH["spring_stiffness"])
    stiffness[[2, 5]] = 1e9, np.nan
    found = est.output_error_batch(
        model, recordings, start={"spring_stiffness": stiffness}, substeps=batch.substeps, progress=False
    )
    for number in range(8):
        if number in (2, 5):
            assert found.result[number] == est.RESULTS.diverged
            assert np.all(np.isnan(found.values[number]))
        else:
            assert found.result[number] == est.RESULTS.successful
            # Begun at another value, so to where kinks of dry friction leave it.
            np.testing.assert_array_less(np.abs(found.values - batch.values)[number], 0.02 * batch.std[number])


def test_steps_that_do_not_suffice_are_said(model: rtac.RTAC, recordings: list[rtac.Recording], batch) -> None:
    found = est.output_error_batch(model, recordings, steps=1, substeps=batch.substeps, progress=False)
    assert all(result == est.RESULTS.steps_exhausted for result in found.result)
    assert np.all(found.steps == 1)


def test_gaps_are_left_out(model: rtac.RTAC, recordings: list[rtac.Recording], batch: est.BatchFit) -> None:
    """What is missing in one recording changes that one alone, as it does in a single fit."""
    first = recordings[1].experiments[0]
    values = first.outputs["cart_position"].values.copy()
    values[50:150] = np.nan
    outputs = first.outputs | {"cart_position": dataclasses.replace(first.outputs["cart_position"], values=values)}
    gap = rtac.Recording(
        (dataclasses.replace(first, outputs=outputs), *recordings[1].experiments[1:]), rig=recordings[1].rig
    )
    changed = [recordings[0], gap, *recordings[2:]]
    found = est.output_error_batch(model, changed, substeps=batch.substeps, progress=False)
    moved = np.abs(found.values - batch.values) / batch.std
    np.testing.assert_array_equal(np.delete(moved, 1, axis=0), 0.0)
    single = est.output_error(model, gap, from_model=True, progress=False)
    for column, name in enumerate(FREE):
        one = single.parameters[name]
        assert abs(found.values[1, column] - one.value) < 0.02 * one.std
    assert np.max(moved[1]) > 0.01


def test_what_cannot_be_fitted_together_is_refused(model: rtac.RTAC, recordings: list[rtac.Recording]) -> None:
    with pytest.raises(ValueError, match="there is no recording"):
        est.output_error_batch(model, [])
    shorter = rtac.Recording(tuple(e.cut(0, 200, e.name) for e in recordings[1].experiments), rig=recordings[1].rig)
    with pytest.raises(ValueError, match="recording 1 has another shape than recording 0"):
        est.output_error_batch(model, [recordings[0], shorter])
    with pytest.raises(ValueError, match="start names total_mass"):
        est.output_error_batch(model, recordings, start={"total_mass": 1.0}, substeps=1)
    with pytest.raises(ValueError, match=r"start of spring_stiffness has shape \(2,\)"):
        est.output_error_batch(model, recordings, start={"spring_stiffness": [1.0, 2.0]}, substeps=1)
    with pytest.raises(ValueError, match="no free parameter"):
        est.output_error_batch(model.fix(*FREE), recordings)


def test_what_converged_from_far_is_where_near_starts_end_and_one_that_runs_away_stops_no_other(
    model: rtac.RTAC, recordings: list[rtac.Recording], batch: est.BatchFit
) -> None:
    random = np.random.default_rng(0)
    several = recordings * 6
    begin = {
        name: np.tile(batch.values[:, i], 6) * (1 + 0.3 * random.uniform(-1, 1, len(several)))
        for i, name in enumerate(batch.names)
    }
    begin["spring_stiffness"][-1] = 1e-6
    found = est.output_error_batch(model, several, start=begin, progress=False)
    assert len(found.result) == len(several)
    there = np.tile(batch.values, (6, 1)), np.tile(batch.std, (6, 1))
    away = np.max(np.abs(found.values - there[0]) / there[1], axis=1)
    right = found.successful & (found.left <= 2.0)
    assert 8 <= np.sum(right) < len(several)
    # Dry friction makes kinks, at which a few rest beside the minimum, within its deviations.
    assert np.mean(away[right] < 0.1) > 0.85
    assert np.max(away[right]) < 2.0
    np.testing.assert_allclose(found.std[right], there[1][right], rtol=0.1)
    assert "times its noise" in str(found)
