"""Excitations: their spectra, their peaks, and that a designed one keeps its limits on an independent rig."""

import numpy as np
import pytest
import scipy.signal

import rtac_jax as rtac
from rtac_jax.effects import InputDelay, LvdtGain
from rtac_jax.measurement import (
    Recording,
    chirp,
    crest_factor,
    from_rest,
    harmonic_grid,
    multisine,
    positive_negative,
    prbs,
    steps,
)
from rtac_jax.virtual_rig import Plan, Rig, record

DT = 0.005
PERIOD = 2000
GRID = {"period": PERIOD, "sample_time": DT}


def test_harmonic_grids():
    every = harmonic_grid("all", **GRID, band=(0.5, 8.0))
    odd = harmonic_grid("odd", **GRID, band=(0.5, 8.0))
    sparse = harmonic_grid("random_odd", **GRID, band=(0.5, 8.0), seed=3)
    assert every.tolist() == list(range(5, 81))
    assert odd.tolist() == list(range(5, 81, 2))
    left_out = np.setdiff1d(odd, sparse)
    assert len(left_out) == len(odd) // 4, "one of every four is left out"
    assert [np.sum(np.isin(odd[k : k + 4], left_out)) for k in range(0, len(odd) - 3, 4)] == [1] * (len(odd) // 4)
    assert not np.array_equal(sparse, harmonic_grid("random_odd", **GRID, band=(0.5, 8.0), seed=4))


@pytest.mark.parametrize("kind", ["all", "odd", "random_odd"])
@pytest.mark.parametrize("seed", [None, 1])
def test_clipping_lowers_the_peak_and_keeps_the_spectrum(kind, seed):
    lines = harmonic_grid(kind, **GRID, band=(0.5, 8.0))
    before = multisine(samples=PERIOD, sample_time=DT, rms=0.2, harmonics=lines, seed=seed)
    after = multisine(samples=PERIOD, sample_time=DT, rms=0.2, harmonics=lines, seed=seed, crest_iterations=500)
    assert crest_factor(after) < min(1.65, 0.9 * crest_factor(before))
    spectrum = np.abs(np.fft.rfft(after))
    np.testing.assert_allclose(spectrum[lines], spectrum[lines][0], rtol=1e-9)
    assert np.max(np.delete(spectrum, lines)) < 1e-9 * spectrum[lines][0]
    assert np.sqrt(np.mean(after**2)) == pytest.approx(0.2)


def test_input_divided_by_the_response_makes_the_output_equally_rich():
    lines = harmonic_grid("all", **GRID, band=(0.5, 8.0))
    system = scipy.signal.TransferFunction([1.0], [1.0, 0.4, 108.0])
    size = np.abs(scipy.signal.freqresp(system, 2 * np.pi * lines / (PERIOD * DT))[1])
    periods = 8
    current = multisine(
        samples=periods * PERIOD, period=PERIOD, sample_time=DT, rms=0.2, harmonics=lines, amplitudes=1 / size,
        crest_iterations=200,
    )  # fmt: skip
    a, b, c, d, _ = scipy.signal.cont2discrete((*scipy.signal.tf2ss([1.0], [1.0, 0.4, 108.0]),), DT)
    out = scipy.signal.dlsim((a, b, c, d, DT), current)[1][-PERIOD:, 0]
    rich = np.abs(np.fft.rfft(out))[lines]
    assert rich.max() / rich.min() < 1.02


def test_positive_and_negative_together_have_odd_harmonics_only():
    wave = multisine(samples=PERIOD, sample_time=DT, rms=0.2, band=(0.5, 8.0), seed=1)
    spectrum = np.abs(np.fft.rfft(positive_negative(wave)))
    assert spectrum[::2].max() < 1e-9 * spectrum[1::2].max()


@pytest.mark.parametrize("seed", range(5))
def test_a_free_body_driven_from_rest_swings_about_its_place(seed):
    wave = multisine(samples=PERIOD, sample_time=DT, rms=0.2, band=(0.5, 8.0), seed=seed)
    drift = {}
    for name, one in (("as it is", wave), ("from rest", from_rest(wave))):
        speed = np.cumsum(np.tile(one, 3)) * DT
        place = np.cumsum(speed) * DT
        drift[name] = abs(place[-1] - place[PERIOD - 1]) / np.ptp(
            place[:PERIOD] - np.linspace(0, place[PERIOD - 1], PERIOD)
        )
    assert drift["from rest"] < 0.5
    assert np.sort(from_rest(wave)) == pytest.approx(np.sort(wave))
    with pytest.raises(ValueError, match="wave: has a mean"):
        from_rest(wave + 0.01)
    if seed == 0:
        assert drift["as it is"] > 1


def test_steps():
    assert steps(samples=7, hold=2, levels=[0.0, 0.3, -0.3]).tolist() == [0.0, 0.0, 0.3, 0.3, -0.3, -0.3, 0.0]


WAVES = {
    "multisine": multisine(samples=1600, sample_time=DT, rms=0.1, band=(0.5, 8.0), crest_iterations=100),
    "chirp": chirp(samples=1600, sample_time=DT, amplitude=0.2, band=(1.0, 3.0)),
    "prbs": prbs(samples=1600, hold=40, amplitude=0.2, seed=1),
    "steps": steps(samples=1600, hold=100, levels=[0.2, -0.2]),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "multisine")) for name in WAVES]
)
def test_design_keeps_its_limits_on_an_independent_rig_and_in_a_file(name, tmp_path):
    angles = (0.2, 1.4, -2.5)
    made = rtac.design_excitation(
        rtac.RTAC.paper(), 10 * WAVES[name], sample_time=DT, initial_angles=angles, amplitudes=(1.0, 0.5), travel=0.004
    )
    made.save(tmp_path / "excitation.h5")
    played = Recording.load(tmp_path / "excitation.h5")
    assert "prediction of the model" in played.comment
    assert [e.initial_arm_angle for e in played] == list(angles)
    peaks = [np.max(np.abs(e.inputs["current"].values)) for e in played]
    assert peaks[1] == pytest.approx(0.5 * peaks[0], rel=0.2), "amplitudes in turn"
    for experiment in played:
        current, angle = experiment.inputs["current"].values, experiment.outputs["arm_angle"].values
        no_grip = np.abs(np.cos(angle)) <= 0.05
        assert np.all(current[no_grip] == 0)
        assert np.max(np.abs(experiment.outputs["cart_position"].values)) <= 0.004
    assert any(np.any(np.abs(np.cos(e.outputs["arm_angle"].values)) <= 0.05) for e in played), "an arm passes there"
    # The virtual rig shares no code with the model.
    plans = [
        Plan(e.name, "forced", e.duration, DT, e.inputs["current"].values, initial_angle=e.initial_arm_angle or 0.0)
        for e in played
    ]
    for predicted, shown in zip(played, record(Rig(encoder=True, quantisation_bits=None), plans, seed=1), strict=True):
        first = slice(0, 400)
        error = predicted.outputs["cart_position"].values[first] - shown.outputs["cart_position"].values[first]
        assert np.max(np.abs(error)) < 2e-4
        assert np.max(np.abs(shown.outputs["cart_position"].values)) <= 1.25 * 0.004


@pytest.mark.parametrize(
    "effect", [InputDelay(0.03), pytest.param(InputDelay(0.007), marks=pytest.mark.slow), LvdtGain(-0.3)], ids=str
)
def test_the_cart_itself_keeps_its_travel_whatever_delays_the_current_or_scales_the_sensor(effect):
    model, limit = rtac.RTAC.paper() + effect, 0.0025
    angles = (0.0, 1.4)
    made = rtac.design_excitation(
        model, 10 * WAVES["multisine"], sample_time=DT, initial_angles=angles, travel=limit, dead_band=0.05
    )
    again = rtac.simulate(model, made, start={e.name: (0.0, 0.0, e.initial_arm_angle, 0.0) for e in made})
    for one in made:
        simulated, predicted = again[one.name], one.outputs
        assert np.max(np.abs(simulated.states["cart_position"])) <= limit
        np.testing.assert_allclose(simulated.cart_position, predicted["cart_position"].values, atol=1e-6)
        np.testing.assert_allclose(simulated.arm_angle, predicted["arm_angle"].values, atol=1e-3)
        no_grip = np.abs(np.cos(predicted["arm_angle"].values)) <= 0.05
        assert np.all(one.inputs["current"].values[no_grip] == 0)
    assert any(np.any(np.abs(np.cos(e.outputs["arm_angle"].values)) <= 0.05) for e in made), "an arm passes there"
    assert max(np.max(np.abs(again[e.name].states["cart_position"])) for e in made) > 0.6 * limit


@pytest.mark.parametrize("seconds", [0.6, pytest.param(1.75, marks=pytest.mark.slow)])
def test_the_travel_holds_also_while_the_cart_swings_out(seconds):
    """A current that ends while the motion still grows; played on a virtual rig, whose integrator is its own."""
    limit, step = 0.001, 0.01
    wave = np.sin(10.38 * step * np.arange(round(seconds / step)))  # at the resonance
    made = rtac.design_excitation(rtac.RTAC.paper(), wave, sample_time=step, travel=limit)
    (designed,) = made
    assert designed.samples == len(wave)
    current = np.pad(designed.inputs["current"].values, (0, 200))
    rig = Rig(position_noise=1e-7, quantisation_bits=None)
    (played,) = record(rig, [Plan("a", "forced", step * len(current), step, current)], seed=1)
    reach = np.max(np.abs(played.outputs["cart_position"].values))
    assert 0.5 * limit < reach < limit + 5e-7  # five deviations of the sensor


@pytest.mark.slow
def test_what_is_foretold_of_a_delayed_current_is_what_an_independent_rig_does():
    made = rtac.design_excitation(
        rtac.RTAC.paper() + InputDelay(0.03), 10 * WAVES["chirp"], sample_time=DT, initial_angles=(0.2,), travel=0.004
    )
    (foretold,) = made
    plan = Plan("a", "forced", foretold.duration, DT, foretold.inputs["current"].values, initial_angle=0.2)
    error = {}
    for delay in (0.03, 0.0):
        (shown,) = record(Rig(input_delay=delay, encoder=True, quantisation_bits=None), [plan], seed=1)
        away = foretold.outputs["cart_position"].values - shown.outputs["cart_position"].values
        error[delay] = float(np.max(np.abs(away[:400])))
    assert error[0.03] < 2e-4
    assert error[0.0] > 5 * error[0.03]


@pytest.mark.parametrize("limit", [0.1, 0.02])
def test_torque_binds_where_travel_does_not(limit):
    """A rig of another motor constant: the largest current is that of the limit, and the cart stays well within its travel."""
    model = rtac.RTAC.paper().with_values({"torque_constant": 0.04})
    made = rtac.design_excitation(
        model, 100 * WAVES["multisine"], sample_time=DT, initial_angles=(0.2,), travel=1.0, torque_limit=limit
    )
    current = made["condition_1"].inputs["current"].values
    assert 0.04 * np.max(np.abs(current)) == pytest.approx(limit, rel=1e-9)
    assert np.max(np.abs(made["condition_1"].outputs["cart_position"].values)) < 0.1
    assert f"|N| <= {limit:g} N m" in made.comment


def test_design_leaves_alone_what_is_within_the_limits():
    wave = 0.8 * WAVES["multisine"]
    made = rtac.design_excitation(rtac.RTAC.paper(), wave, sample_time=DT)
    angle = made["condition_1"].outputs["arm_angle"].values
    expected = np.where(np.abs(np.cos(angle)) <= 0.05, 0.0, wave)
    assert np.array_equal(made["condition_1"].inputs["current"].values, expected)


def test_each_experiment_may_have_a_current_of_its_own():
    waves = np.stack([WAVES["multisine"], WAVES["chirp"]])
    made = rtac.design_excitation(rtac.RTAC.paper(), waves, sample_time=DT, initial_angles=(0.2, -0.4))
    for experiment, wave in zip(made, waves, strict=True):
        current = experiment.inputs["current"].values
        np.testing.assert_array_equal(current[current != 0], wave[current != 0])
        assert np.count_nonzero(current) > 0.8 * len(wave)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: harmonic_grid("even", **GRID, band=(1, 2)), "kind: is 'even'"),
        (lambda: harmonic_grid("odd", **GRID, band=(1.0, 1.01)), "band: no odd harmonic"),
        (lambda: harmonic_grid("all", **GRID, band=(1, 200)), "band: 200 Hz"),
        (lambda: harmonic_grid("random_odd", **GRID, band=(1, 2), group=1), "group: is 1"),
        (lambda: multisine(samples=9, sample_time=DT, rms=1, harmonics=[1, 2], amplitudes=[1.0]), "amplitudes: give 2"),
        (lambda: multisine(samples=9, sample_time=DT, rms=1, harmonics=[1], crest_iterations=-1), "crest_iterations"),
        (lambda: steps(samples=9, hold=1, levels=[]), "levels: give"),
        (lambda: crest_factor(np.zeros(9)), "zero throughout"),
        (lambda: _design(current=np.zeros(20)), "current: must be finite and not zero"),
        (lambda: _design(travel=-1.0), "travel: is -1"),
        (lambda: _design(torque_limit=0.0), "torque_limit: is 0"),
        (lambda: _design(dead_band=1.0), "dead_band: is 1"),
        (lambda: _design(amplitudes=(2.0,)), "amplitudes: must be above 0"),
        (lambda: _design(initial_angles=()), "initial_angles, amplitudes: are empty"),
        (lambda: _design(initial_angles=(np.pi / 2,)), "no grip"),
        (lambda: _design(current=np.ones((3, 20))), "has 3 rows for 1 initial_angles"),
        (lambda: _design(current=np.full(20, 1e-6)), "too weak to move the cart"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def _design(current=None, **options):
    wave = np.ones(20) if current is None else current
    return rtac.design_excitation(rtac.RTAC.paper(), wave, sample_time=DT, **options)
