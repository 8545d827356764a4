"""Are conditions equal, or does a mode drift with what distinguishes them? On linear systems simulated here by SciPy."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

import estimators as est
from rtac_jax.measurement import Experiment, Recording

DT = 0.02


def drifting(slope, seed=6):
    """Twelve conditions whose natural frequency falls with the amplitude, in an order that has nothing to do with it."""
    random = np.random.default_rng(seed)
    sizes = random.permutation(np.linspace(0.5, 2.0, 12))
    experiments = []
    for i, size in enumerate(sizes):
        current = size * random.standard_normal(1500)
        system = scipy.signal.tf2ss([2.0, 30.0], [1.0, 1.6, 110.0 * (1 - slope * size) ** 2])
        a, b, c, d, _ = scipy.signal.cont2discrete(system, DT)
        out = scipy.signal.dlsim((a, b, c, d, DT), current[:, None])[1][:, 0] + 0.05 * random.standard_normal(1500)
        experiments.append(
            Experiment.of(f"run_{i + 1}", kind="forced", sample_time=DT, current=current, cart_position=out)
        )
    return est.prediction_error(Recording(tuple(experiments)), structure="output_error", compensate=False)


@pytest.mark.slow
def test_a_drift_is_found_and_named():
    found = drifting(0.02)
    test = found.equality()
    assert not test.equal
    assert test.drifting[0] == "natural frequency"
    trend = test.best_trend("natural frequency")
    assert trend is not None
    # The truth drifts with the size of the input, and the output's rms, which grows a little less evenly, follows.
    assert trend.covariate == "input"
    assert trend.fraction > 0.9
    # 0.02 of 10.5 rad/s over inputs from 0.5 to 2.
    assert trend.slope == pytest.approx(-0.02 * 1.5 * np.sqrt(110), rel=0.1)
    assert "drifts with the input's amplitude" in str(test)
    output = next(t for t in test.trends[test.names.index("natural frequency")] if t.covariate == "amplitude")
    assert output.fraction > 0.8
    assert output.slope == pytest.approx(-0.02 * 1.5 * np.sqrt(110), rel=0.2)
    assert "drifts" in test.plot()._suptitle.get_text()
    assert found.plot()._suptitle.get_text()


def test_a_drift_with_what_only_the_user_knows_is_found_and_named():
    """The spring softens with a temperature that has nothing to do with amplitude or order."""
    random = np.random.default_rng(9)
    warm = random.permutation(np.linspace(18.0, 30.0, 12))
    experiments = []
    for i, degrees in enumerate(warm):
        current = random.standard_normal(1500)
        system = scipy.signal.tf2ss([2.0, 30.0], [1.0, 1.6, 110.0 * (1 - 0.002 * (degrees - 18.0)) ** 2])
        a, b, c, d, _ = scipy.signal.cont2discrete(system, DT)
        out = scipy.signal.dlsim((a, b, c, d, DT), current[:, None])[1][:, 0] + 0.05 * random.standard_normal(1500)
        experiments.append(
            Experiment.of(f"run_{i + 1}", kind="forced", sample_time=DT, current=current, cart_position=out)
        )
    found = est.prediction_error(Recording(tuple(experiments)), structure="output_error", compensate=False)
    assert found.equality().best_trend("natural frequency") is None
    measured = {e.name: float(t) for e, t in zip(experiments, warm, strict=True)}
    test = found.equality(covariates={"temperature": measured})
    trend = test.best_trend("natural frequency")
    assert trend is not None
    assert trend.covariate == "temperature"
    assert trend.slope == pytest.approx(-0.002 * 12 * np.sqrt(110), rel=0.15)
    assert "Natural frequency drifts with temperature" in test.verdict
    with pytest.raises(ValueError, match="temperature has no value for run_2"):
        found.equality(covariates={"temperature": {"run_1": 20.0}})


@pytest.mark.slow
def test_equal_conditions_are_called_equal_as_often_as_said():
    p_values = np.array([drifting(0.0, seed).equality().p_value for seed in range(10)])
    # Uniform between 0 and 1.
    assert np.min(p_values) > 1e-3
    assert 0.2 < np.mean(p_values) < 0.8
    few = drifting(0.0)
    with pytest.raises(ValueError, match=r"2 of 2 condition.s. determine their modes, too few .* at least three"):
        dataclasses.replace(few, models=few.models[:2]).equality()


def test_an_envelope_takes_responses_and_systems():
    found = drifting(0.02)
    omega = np.geomspace(2.0, 50.0, 60)
    covering = est.envelope(found.responses(omega), order_nominal=2)
    assert np.all(covering.covers(found.responses(omega)))
    # Of responses it covers what is interpolated between their frequencies, and not quite what systems do there.
    assert np.all(covering.distance(found.transfer_functions(), omega) < 1.002)
    assert np.all(
        est.envelope(found.transfer_functions(), omega=omega, order_nominal=2).covers(found.transfer_functions())
    )


def test_free_unknowns_of_the_noise_alone_leave_no_condition_out():
    """White noise under a model of coloured noise: a pole on a zero in some conditions, of which G is known as in the others."""
    found = est.prediction_error(equal_plants(3, ([1.0], [1.0]), 0.0, 16), compensate=False, progress=False)
    idle = np.array([one.idle > 0 for one in found])
    assert 1 <= np.sum(idle) < 16
    assert found.equality().left_out == ()
    assert "leaves G as it is" in found.models[int(np.argmax(idle))].verdict
    std = np.array([one.std[0] for one in found])
    assert np.mean(std[idle]) == pytest.approx(np.mean(std[~idle]), rel=0.1)


def test_a_condition_that_is_left_out_keeps_its_number_and_is_counted():
    few = drifting(0.0)
    models = tuple(dataclasses.replace(one, undetermined=int(place == 1)) for place, one in enumerate(few.models))
    found = dataclasses.replace(few, models=models).equality()
    assert f"1 of {len(models)} were left out." in found.verdict
    (bars,) = [c for c in found.plot().get_axes()[0].containers if len(c.lines[0].get_xdata()) == len(models) - 1]
    assert 2 not in bars.lines[0].get_xdata()
    assert max(bars.lines[0].get_xdata()) == len(models)


def test_a_mode_that_only_the_bound_on_stability_keeps_is_called_so():
    one = drifting(0.02)[0]
    assert "stability" not in one.verdict
    assert "bound on stability" in dataclasses.replace(one, poles=one.poles.imag * 1j - 1e-12).verdict


def equal_plants(seed, noise, missing, count=12):
    """Runs of one plant, with noise of a colour, and samples missing at random."""
    random = np.random.default_rng(seed)
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss([2.0, 30.0], [1.0, 1.6, 110.0]), DT)
    experiments = []
    for i in range(count):
        current = random.standard_normal(1500)
        out = scipy.signal.dlsim((a, b, c, d, DT), current[:, None])[1][:, 0]
        out = out + scipy.signal.lfilter(*noise, 0.02 * random.standard_normal(1500))
        out[random.random(1500) < missing] = np.nan
        experiments.append(
            Experiment.of(f"run_{i + 1}", kind="forced", sample_time=DT, current=current, cart_position=out)
        )
    return Recording(tuple(experiments))


@pytest.mark.slow
def test_missing_samples_under_a_model_of_the_noise_make_equal_conditions_no_different():
    """A prediction across a gap is off by more than others, and those after it with it."""
    away, p_values = [], []
    for seed in range(6):
        found = est.prediction_error(
            equal_plants(seed, ([1.0, 0.4], [1.0, -0.95]), 0.15), structure="box_jenkins", compensate=False
        )
        away += [(one.values[:2] - [np.sqrt(110), 0.8 / np.sqrt(110)]) / one.std[:2] for one in found]
        p_values.append(found.equality().p_value)
    assert np.min(p_values) > 2e-3
    assert np.mean(p_values) > 0.2
    assert np.all(np.sqrt(np.mean(np.square(away), axis=0)) < 1.2)
    assert np.all(np.sqrt(np.mean(np.square(away), axis=0)) > 0.8)


def test_unknowns_of_the_noise_that_the_data_leave_free_are_not_called_modes():
    """As where ARMAX describes white noise of the sensor: with as many zeros as poles."""
    few = drifting(0.0)
    shared = dataclasses.replace(few[0].structure, kind="armax", noise_order=2)
    free = tuple(dataclasses.replace(one, undetermined=1, structure=shared) for one in few)
    assert "a structure whose noise has poles of its own would do" in free[0].verdict
    with pytest.raises(ValueError, match=r"leave unknowns free, of the noise model too.*structure='output_error'"):
        dataclasses.replace(few, models=(*few.models[:2], *free[2:])).equality()
