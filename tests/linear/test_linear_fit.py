"""Prediction error against linear systems simulated here in plain NumPy and SciPy."""

import control as ct
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import estimators as est
import rtac_jax as rtac
from rtac_jax.measurement import Experiment, Recording

DT = 0.02
NUMERATOR, DENOMINATOR = [2.0, 30.0], [1.0, 1.6, 110.0]
POLE, ZERO = -0.8 + 1j * np.sqrt(110.0 - 0.64), -15.0
A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(NUMERATOR, DENOMINATOR), DT)
RUNS = 200
# For each shape of the data a structure compiles anew, for some seconds: many tests, here and of equal conditions, have this one.
FEW, LENGTH = 12, 1500


def respond(current, start=(0.0, 0.0)):
    """Outputs of the held system for inputs [run, sample]."""
    state = np.broadcast_to(np.asarray(start), (len(current), 2)).copy()
    out = np.empty_like(current)
    for n in range(current.shape[1]):
        out[:, n] = state @ C[0]
        state = state @ A.T + current[:, n : n + 1] * B[:, 0]
    return out


def recording(current, out, sample_time=DT, **options):
    return Recording(
        tuple(
            Experiment.of(f"run_{i + 1}", kind="forced", sample_time=sample_time, current=u, cart_position=y, **options)
            for i, (u, y) in enumerate(zip(current, out, strict=True))
        )
    )


def simulated(noise, std, *, samples=2000, runs=RUNS, seed=0):
    """Runs from different starts with the noise C(q)/D(q) e given."""
    random = np.random.default_rng(seed)
    current = random.standard_normal((runs, samples))
    clean = respond(current, random.normal(0, 0.05, (runs, 2)))
    white = std * random.standard_normal((runs, samples + 500))
    return current, clean + scipy.signal.lfilter(*noise, white, axis=1)[:, 500:]


# The sampled denominator of G, for structures in which noise passes through the same dynamics.
SHARED = np.poly(scipy.linalg.eigvals(A)).real
NOISES = {
    "output_error": (([1.0], [1.0]), 0.1),
    "box_jenkins": (([1.0, 0.5, 0.3], [1.0, -1.4, 0.6]), 0.03),
    "armax": (([1.0, 0.4, 0.1], SHARED), 0.01),
    "state_space": (([1.0, -0.6, 0.2], SHARED), 0.02),
}
# In slow studies: what their predictors are differs, and not how bands are made.
LONGER = ("box_jenkins", "armax", "state_space")


@pytest.mark.parametrize("structure", [pytest.param(s, marks=[pytest.mark.slow] * (s in LONGER)) for s in NOISES])
def test_known_systems_are_recovered_with_bands_that_hold(structure):
    current, out = simulated(*NOISES[structure])
    found = est.prediction_error(recording(current, out), structure=structure, compensate=False)
    assert all(one.converged for one in found)
    poles = np.array([one.poles[np.argmax(one.poles.imag)] for one in found])
    std = np.array([one.poles_std[np.argmax(one.poles.imag)] for one in found])
    away = np.stack([(poles - POLE).real, (poles - POLE).imag], axis=1) / std
    # Of 400 normal numbers one lies beyond three on average; five or more do in one of 250 such tests.
    assert np.sum(np.abs(away) > 3) <= 4
    assert np.max(np.abs(away)) < 4.5
    assert 0.92 < np.mean(np.abs(away) < 1.96) < 0.98
    gains = np.array([(one.static_gain - 30 / 110) / one.static_gain_std for one in found])
    zeros = np.array([(one.zeros[0].real - ZERO) / one.zeros_std[0, 0] for one in found])
    assert 0.90 < np.mean(np.abs(gains) < 1.96) < 0.985
    assert 0.90 < np.mean(np.abs(zeros) < 1.96) < 0.985
    if structure != "output_error":
        white = np.mean([one.residuals.white for one in found])
        assert white > 0.95
    # At 1 %, seven or more of 200 are rejected in one of 200 such tests.
    assert np.sum([not one.residuals.independent for one in found]) <= 6


@pytest.mark.slow
@pytest.mark.parametrize("noise", [NOISES["box_jenkins"][0], ([1.0], [1.0, -0.9])])
def test_coloured_errors_are_not_taken_for_a_response_to_the_input(noise):
    """Output error does not weigh its errors, so what the fit took out of them is not small beside their least coloured part."""
    current, out = simulated(noise, 0.03, seed=5)
    found = est.prediction_error(recording(current, out), structure="output_error", compensate=False)
    p_values = np.array([one.residuals.cross_p for one in found])
    assert np.sum(p_values < 0.01) <= 6
    assert 2 <= np.sum(p_values < 0.05) <= 20  # of 200, 10 are expected; so a test that rejects nothing fails too
    assert not any(one.residuals.white for one in found)


@pytest.mark.slow
def test_missing_samples_are_no_response_to_the_input():
    current, out = simulated(([1.0], [1.0]), 0.1, seed=6)
    out = np.where(np.random.default_rng(7).random(out.shape) < 0.3, np.nan, out)
    found = est.prediction_error(recording(current, out), structure="output_error", compensate=False)
    p_values = np.array([one.residuals.cross_p for one in found])
    assert np.sum(p_values < 0.01) <= 6
    assert 2 <= np.sum(p_values < 0.05) <= 20  # of 200, 10 are expected


def test_bands_of_the_response_hold_at_every_frequency():
    current, out = simulated(*NOISES["box_jenkins"], seed=1)
    found = est.prediction_error(recording(current, out), structure="output_error", compensate=False)
    omega = np.geomspace(1.0, 60.0, 12)
    truth = np.polyval(NUMERATOR, 1j * omega) / np.polyval(DENOMINATOR, 1j * omega)
    away = np.array([np.abs(one.response - truth) / one.radius(0.95) for one in found.responses(omega)])
    # A disc for an error that is not circular holds nearly as often. Coloured noise is counted.
    assert 0.9 < np.mean(away < 1) < 0.98
    one = found[0]
    response = found.responses(omega)[0].response
    for system in (one.transfer_function(), one.state_space()):
        np.testing.assert_allclose(np.asarray(system(1j * omega)), response, rtol=1e-9)
    np.testing.assert_allclose(np.sort_complex(one.transfer_function().poles()), np.sort_complex(one.poles), rtol=1e-9)
    assert isinstance(one.noise_model(), ct.TransferFunction)


@pytest.fixture(scope="module")
def different():
    """Conditions of different lengths, some with gaps, and noise of their own."""
    random = np.random.default_rng(2)
    current, out = simulated(([1.0, 0.5], [1.0, -0.9]), 0.03, samples=LENGTH, runs=FEW, seed=2)
    experiments = []
    for i, (u, y) in enumerate(zip(current, out, strict=True)):
        samples = int(random.integers(300, 500)) if i else LENGTH
        y = y[:samples].copy()
        if i % 4 == 0:
            y[random.integers(0, samples, 20)] = np.nan
        experiments.append(
            Experiment.of(f"run_{i + 1}", kind="forced", sample_time=DT, current=u[:samples], cart_position=y)
        )
    return Recording(tuple(experiments))


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["output_error", "box_jenkins"])
def test_all_conditions_at_once_give_what_each_gives_alone(different, structure):
    together = est.prediction_error(different, structure=structure, compensate=False)
    for name in different.names:
        alone = est.prediction_error(different.select([name]), structure=structure, compensate=False)[0]
        np.testing.assert_allclose(together[name].values, alone.values, rtol=1e-8)
        np.testing.assert_allclose(together[name].std, alone.std, rtol=1e-5)
        np.testing.assert_allclose(together[name].noise_numerator, alone.noise_numerator, atol=1e-6)


def test_criteria_count_samples_and_what_was_estimated(different):
    """Ljung (1999), section 16.4."""
    found = est.prediction_error(different, structure="output_error", compensate=False)
    unknowns = 4 + 2  # frequency, damping and two gains, and the two states at the start
    for one in found:
        error = (one.output - one.simulated)[np.isfinite(one.output)]
        count, loss = len(error), np.mean(error**2)
        assert one.fpe == pytest.approx(loss * (count + unknowns) / (count - unknowns), rel=1e-9)
        assert one.aic == pytest.approx(count * np.log(loss) + 2 * unknowns, rel=1e-9)
        assert one.bic == pytest.approx(count * np.log(loss) + np.log(count) * unknowns, rel=1e-9)


def test_predictions_over_any_horizon_are_those_of_the_difference_equation():
    current, out = simulated(([1.0, 0.5, 0.3], [1.0, -1.4, 0.6]), 0.03, samples=LENGTH, runs=FEW)
    one = est.prediction_error(recording(current, out), structure="box_jenkins", compensate=False)[0]
    c, d = one.noise_numerator, one.noise_denominator
    error = out[0] - one.predict(1)
    disturbance = out[0] - one.simulated
    # v = -d1 v(t-1) - ... + e + c1 e(t-1) + ..., run on from what is known, with errors to come at zero.
    for horizon in (1, 2, 5):
        for t in (50, 123, 399):
            v, e = disturbance.copy(), error.copy()
            e[t - horizon + 1 :] = 0
            for n in range(t - horizon + 1, t + 1):
                v[n] = -d[1] * v[n - 1] - d[2] * v[n - 2] + c[1] * e[n - 1] + c[2] * e[n - 2]
            assert one.predict(horizon)[t] == pytest.approx(one.simulated[t] + v[t], abs=1e-10)
    fits = [one.fit_percent(k) for k in (1, 2, 5, 20, None)]
    assert fits == sorted(fits, reverse=True)
    assert np.std(error) == pytest.approx(one.innovation_std, rel=0.05)
    with pytest.raises(ValueError, match="horizon"):
        one.predict(0)


@pytest.mark.parametrize("hold", ["zoh", *(pytest.param(hold, marks=pytest.mark.slow) for hold in ("foh", "bl"))])
def test_the_input_between_samples_is_counted(hold):
    random = np.random.default_rng(3)
    fine, samples = 20, LENGTH
    if hold == "zoh":
        slow = random.standard_normal(samples)
        fast = np.repeat(slow, fine)
    else:
        # Smooth enough that straight lines, or a spline, are what the input does.
        time = np.arange(samples * fine) * DT / fine
        omega, phase = random.uniform(2, 40, 30), random.uniform(0, 6.28, 30)
        fast = np.sin(omega * time[:, None] + phase).sum(axis=1)
        slow = fast[::fine]
        if hold == "foh":
            fast = np.interp(time, time[::fine], slow)
    kind = "zoh" if hold == "zoh" else "foh"
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(NUMERATOR, DENOMINATOR), DT / fine, method=kind)
    out = scipy.signal.dlsim((a, b, c, d, DT / fine), fast[:, None])[1][::fine, 0]
    noisy = out + 1e-3 * random.standard_normal((FEW, samples))
    found = est.prediction_error(
        recording(np.tile(slow, (FEW, 1)), noisy, intersample=hold), structure="output_error", compensate=False
    )[0]
    upper = int(np.argmax(found.poles.imag))
    assert abs((found.poles[upper] - POLE).real) < 3.5 * found.poles_std[upper, 0]
    assert abs((found.poles[upper] - POLE).imag) < 3.5 * found.poles_std[upper, 1]
    assert abs(found.zeros[0].real - ZERO) < 3.5 * found.zeros_std[0, 0]


TWO = ([2.0, 8.0, 900.0, 9000.0], np.convolve([1.0, 1.6, 110.0], [1.0, 2.4, 1400.0]))


def two_modes(runs=6, samples=1500):
    random = np.random.default_rng(4)
    current = random.standard_normal((runs, samples))
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(*TWO), DT)
    out = np.stack([scipy.signal.dlsim((a, b, c, d, DT), u[:, None])[1][:, 0] for u in current])
    return recording(current, out + 0.05 * random.standard_normal(out.shape))


@pytest.mark.slow
def test_the_search_finds_as_many_modes_as_there_are():
    found = est.prediction_error(two_modes(), structure="output_error", modes="search", compensate=False)
    assert found.structure.modes == 2
    assert set(found.searched) == {1, 2, 3}
    truth = np.sort_complex(np.roots(TWO[1]))
    for one in found:
        order = np.argsort([np.argmin(np.abs(truth - p)) for p in one.poles])
        away = (one.poles[order] - truth).imag / one.poles_std[order, 1]
        assert np.max(np.abs(away)) < 4
    one_mode = est.prediction_error(two_modes(), structure="output_error", modes=1, compensate=False)
    assert not any(one.residuals.independent for one in one_mode)
    assert "raise modes" in one_mode.verdict
    assert "BIC" in str(found)


def test_a_start_finds_what_a_search_over_spectra_loses_in_noise():
    """A sharp mode under noise of twice its size; the rig's model linearised, or a linear one, says where it is."""
    random = np.random.default_rng(9)
    mass, inertia, moment, spring, viscous = 1.23, 9.5e-5, 1.06e-3, 25 * 132.6, 0.0126
    denominator = [
        mass * inertia - moment**2,
        viscous * inertia,
        spring * inertia,
    ]  # of equations (1) and (2), as printed
    truth = np.roots(denominator)[np.argmax(np.roots(denominator).imag)]
    gain = 1e-4 * np.array([2.0, 30.0])
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(gain, denominator), DT)
    current = random.standard_normal((FEW, LENGTH))
    out = np.stack([scipy.signal.dlsim((a, b, c, d, DT), u[:, None])[1][:, 0] for u in current])
    data = recording(current, out + 2 * np.std(out) * random.standard_normal(out.shape))
    model = rtac.RTAC(rtac.RigidBody(mass, inertia, moment, spring, 0.08), (rtac.effects.CartViscous(viscous),))
    away = {}
    for name, start in (("none", None), ("linear", ct.tf([1.0], denominator)), ("rig", model)):
        found = est.prediction_error(data, structure="output_error", compensate=False, start=start, progress=False)
        away[name] = [np.min(np.abs(one.poles - truth)) for one in found]
    assert np.max(away["none"]) > 2
    assert np.max(away["linear"]) < 0.1
    assert np.max(away["rig"]) < 0.1


def test_means_are_taken_off_only_where_asked():
    current, out = simulated(([1.0], [1.0]), 0.02, samples=LENGTH, runs=FEW, seed=3)
    options = {"structure": "output_error", "compensate": False, "progress": False}
    moved = recording(current + 1.0, out + 5.0)
    flat = recording(current - current.mean(axis=1)[:, None], out - out.mean(axis=1)[:, None])
    asked = est.prediction_error(moved, detrend=True, **options)
    by_hand = est.prediction_error(flat, **options)
    np.testing.assert_allclose([o.values for o in asked], [o.values for o in by_hand], rtol=1e-8)
    assert all(np.min(np.abs(one.poles - POLE)) < 0.1 for one in asked)
    left = est.prediction_error(moved, **options)
    assert all(np.min(np.abs(one.poles - POLE)) > 1 for one in left), "an offset is no part of the model set"


@pytest.mark.parametrize(
    "structure", ["output_error", *(pytest.param(x, marks=pytest.mark.slow) for x in ("armax", "state_space"))]
)
def test_models_are_stable_even_of_a_system_that_is_not(structure):
    """The truth's poles lie at +0.05 +- 10.5j."""
    random = np.random.default_rng(10)
    a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(NUMERATOR, [1.0, -0.1, 110.0]), DT)
    current = random.standard_normal((FEW, LENGTH))
    out = np.stack([scipy.signal.dlsim((a, b, c, d, DT), u[:, None])[1][:, 0] for u in current])
    noisy = out + 0.02 * random.standard_normal(out.shape)
    found = est.prediction_error(recording(current, noisy), structure=structure, compensate=False, progress=False)
    for one in found:
        assert np.all(one.poles.real < 0)
        assert np.max(np.abs(one.poles.imag)) == pytest.approx(np.sqrt(110), rel=0.01)
        assert np.all(np.abs(np.roots(one.noise_denominator)) < 1 + 1e-9)
        assert np.all(np.abs(np.roots(one.noise_numerator)) < 1 + 1e-9)


@pytest.mark.slow
def test_zeros_as_many_as_asked_for():
    random = np.random.default_rng(5)
    current = random.standard_normal((3, 800))
    for zeros, top in ((0, [30.0]), (2, [0.3, 2.0, 30.0])):
        a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(top, DENOMINATOR), DT)
        out = np.stack([scipy.signal.dlsim((a, b, c, d, DT), u[:, None])[1][:, 0] for u in current])
        data = recording(current, out + 0.01 * random.standard_normal(out.shape))
        found = est.prediction_error(data, structure="output_error", zeros=zeros, compensate=False)
        for one in found:
            assert len(one.zeros) == zeros
            assert abs(one.static_gain - 30 / 110) < 4 * one.static_gain_std
            truth = np.roots(top)
            if zeros:
                assert np.max(np.abs(np.sort(one.zeros.imag) - np.sort(truth.imag)) / one.zeros_std[:, 1]) < 4


def refused(current, out, **options):
    with pytest.raises(ValueError, match=r"\w") as caught:
        est.prediction_error(recording(current, out), compensate=False, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert message.rstrip().endswith(".")
    return message


def test_what_cannot_be_fitted_is_refused_in_one_sentence():
    random = np.random.default_rng(7)
    current, out = simulated(([1.0], [1.0]), 0.1, samples=100, runs=1)
    # Box-Jenkins with one mode: two poles, one zero and a gain, C and D of order two, two states each of G and H.
    message = refused(current[:, :12], out[:, :12])
    assert "12 samples" in message
    assert "at least 13" in message
    assert "unstable" in refused(current, out, start=ct.tf([1.0], [1.0, -0.1, 110.0]))
    assert "all samples are 1" in refused(current, np.ones_like(out))
    assert "current is constant" in refused(np.ones_like(current), out)
    one_line = np.sin(2 * np.pi * 5 * np.arange(100) / 100)[None]
    assert "at 1 frequencies only" in refused(one_line, out)
    assert "modes" in refused(current, out, modes=7)
    assert "structure" in refused(current, out, structure="arx")
    assert "zeros" in refused(current, out, zeros=4)
    assert "noise_order" in refused(current, out, structure="armax", noise_order=3)
    turned = recording(current, out, initial_arm_angle=np.pi / 2)
    with pytest.raises(ValueError, match="excitation vanishes"):
        est.prediction_error(turned, angles={"run_1": np.full(100, np.pi / 2)})
    current, missing = simulated(([1.0], [1.0]), 0.1, samples=LENGTH, runs=FEW)
    missing[:, random.integers(0, LENGTH, 75)] = np.nan
    assert est.prediction_error(recording(current, missing), structure="output_error", compensate=False)[0].converged


@pytest.mark.slow
def test_one_sample_more_than_is_refused_is_fitted():
    current, out = simulated(([1.0], [1.0]), 0.1, samples=100, runs=1)
    assert est.prediction_error(recording(current[:, :13], out[:, :13]), compensate=False)[0].structure.count == 12


@pytest.mark.slow
def test_as_good_as_a_subspace_method_on_the_same_data():
    """Errors of the pole over 40 runs beside those of N4SID, which is the start of many toolboxes."""
    pandas = pytest.importorskip("pandas")
    nfoursid = pytest.importorskip("nfoursid.nfoursid")
    current, out = simulated(*NOISES["state_space"], runs=40, seed=8)
    found = est.prediction_error(recording(current, out), structure="state_space", compensate=False)
    ours = np.array([one.poles[np.argmax(one.poles.imag)] - POLE for one in found])
    theirs = []
    for u, y in zip(current, out, strict=True):
        fit = nfoursid.NFourSID(pandas.DataFrame({"u": u, "y": y}), ["y"], ["u"], num_block_rows=15)
        fit.subspace_identification()
        system, _ = fit.system_identification(rank=2)
        poles = np.log(np.linalg.eigvals(system.a).astype(complex)) / DT
        theirs.append(poles[np.argmax(poles.imag)] - POLE)
    size = [float(np.sqrt(np.mean(np.abs(errors) ** 2))) for errors in (ours, np.array(theirs))]
    print(f"root mean square error of the pole [rad/s]: prediction error {size[0]:.4f}, N4SID {size[1]:.4f}")
    assert size[0] <= size[1]
