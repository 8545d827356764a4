"""Whether the fitted model meets the envelope: said with the number and the frequency, and only where it does not."""

import control as ct
import numpy as np
import pytest

import estimators as est
from estimators.plots import plot_envelope
from estimators.uncertainty.closed_form_check import closed_form_check
from estimators.uncertainty.fitted_model import FittedInEnvelope, fitted_in_envelope
from rtac_jax import RTAC, virtual_rig
from rtac_jax.effects import InputDelay
from rtac_jax.measurement import from_rest, multisine

MODEL = RTAC.paper()
OMEGA = np.geomspace(6.3, 31.0, 80)


def rig(omega, *, damping=1.0):
    """Equation (1) and (2) at small motions, in plain NumPy, with the cart's friction this many times as large."""
    value = {name: float(MODEL[name]) for name in MODEL.parameters}
    s = 1j * omega
    arm = value["arm_inertia"] * s**2 + 0.5 * (value["arm_viscous.positive"] + value["arm_viscous.negative"]) * s
    cart = value["total_mass"] * s**2 + damping * value["cart_viscous.coefficient"] * s + value["spring_stiffness"]
    push = value["eccentric_moment"] * s**2
    return -push * value["torque_constant"] / (cart * arm - push**2)


def envelope(damping, **options):
    plants = np.stack([factor * rig(OMEGA, damping=damping) for factor in (0.9, 1.0, 1.1)])
    return est.envelope(plants, omega=OMEGA, order_nominal=2, progress=False, **options)


def test_responses_of_the_model_itself_hold_it():
    found = fitted_in_envelope(MODEL, envelope(1.0))
    assert found.agrees
    assert found.distance < 1
    assert abs(found.peak_db) < 1.5
    assert found.resonance == pytest.approx(10.42, rel=0.01)
    (said,) = found.sentences()
    assert "inside W" in said
    np.testing.assert_allclose(found.response, rig(found.frequency), rtol=1e-9)
    assert "spring" not in said
    sprung = fitted_in_envelope(MODEL, envelope(1.0), with_spring=rig)
    assert "dry friction and, as the conditions, with the electric spring on the arm, lies" in sprung.sentences()[0]


@pytest.fixture(scope="module")
def held_by_friction():
    """Responses of a cart that moves so little that dry friction damps it seven times as much."""
    covered = envelope(7.0)
    return covered, fitted_in_envelope(MODEL, covered)


def test_a_peak_that_friction_took_away_is_told_with_number_and_frequency(held_by_friction):
    covered, found = held_by_friction
    assert not found.agrees
    true = (
        np.abs(rig(np.linspace(8, 13, 5000))).max() / np.abs(covered.nominal_response(np.linspace(8, 13, 5000))).max()
    )
    assert found.peak_db == pytest.approx(-20 * np.log10(true), abs=0.3)
    gap = np.abs(rig(found.frequency) / covered.nominal_response(found.frequency) - 1) / covered.weight_magnitude(
        found.frequency
    )
    assert found.distance == pytest.approx(gap.max(), rel=1e-9)
    said, remedy = found.sentences()
    assert f"{gap.max():.1f} times outside W, most at {found.frequency[gap.argmax()]:.3g} rad/s" in said
    assert f"{-found.peak_db:.1f} dB below" in said
    assert "with r the frequency over 1.66 Hz, for 20 s or longer" in remedy
    # The arm swings about half a radian in rms about theta = 0: K_m i = J theta'' at the resonance.
    swing = 0.55 * float(MODEL["arm_inertia"]) * found.resonance**2 / float(MODEL["torque_constant"])
    assert f"{1e3 * swing:.2g} mA rms" in remedy


def test_where_the_peaks_are_near_no_other_excitation_is_advised():
    found = fitted_in_envelope(MODEL, envelope(1.45))
    assert not found.agrees
    assert -3.0 < found.peak_db < -1.0
    assert "another excitation would change little" in found.sentences()[1]


def test_friction_that_a_fit_does_not_tell_from_nothing_is_not_blamed():
    idle = MODEL.with_values({"cart_coulomb.level": 4e-8})
    blamed, told = (fitted_in_envelope(idle, envelope(1.45), nothing=n) for n in ((), ("cart_coulomb.level",)))
    assert blamed.dry
    assert not told.dry
    assert told.distance == blamed.distance
    assert "has the dry friction" in blamed.sentences()[1]
    assert "Ask `diagnose` what it lacks" in told.sentences()[1]


@pytest.mark.slow
def test_a_closed_form_of_a_cart_that_friction_holds_is_not_held_against_the_envelope():
    rig = virtual_rig.Rig(encoder=True, cart_coulomb=0.03)
    waves = [from_rest(multisine(samples=2000, sample_time=0.01, rms=0.02, band=(1.0, 5.0), seed=n)) for n in range(4)]
    plans = [
        virtual_rig.Plan(f"condition_{n}", "forced", 20.0, 0.01, w, initial_angle=0.1 * n - 0.15 + np.pi * (n % 2))
        for n, w in enumerate(waves)
    ]
    recording = virtual_rig.record(rig, plans, seed=1)
    with pytest.raises(
        ValueError, match=r"scatter over the experiments by more than 30 % of their means \(.*friction holds the cart"
    ):
        closed_form_check(
            recording,
            envelope(1.0),
            est.frequency_responses(
                virtual_rig.record(virtual_rig.Rig(encoder=True, cart_coulomb=0.0003), plans, seed=1)
            ),
        )


def test_a_mode_that_the_model_has_not_is_named():
    mode = ct.tf([1.0, 2.0, 6.8**2], [1.0, 0.2, 6.6**2])
    plain = ct.tf([-1.2], [1.0, 0.47, 10.42**2])
    plants = np.stack([factor * rig(OMEGA) for factor in (0.9, 1.1)])
    covered = est.envelope(plants, omega=OMEGA, nominal=plain * mode, within_db=60.0, progress=False)
    found = fitted_in_envelope(MODEL, covered)
    assert found.spurious == pytest.approx((6.6,), rel=0.03)
    assert "has a mode at 6.6 rad/s that the fitted model has not" in found.sentences()[0]


def test_the_picture_shows_the_fitted_curve(held_by_friction):
    covered, found = held_by_friction
    with_it, without = plot_envelope(covered, fitted=found), plot_envelope(covered)
    assert "fitted model, linearised" in [text.get_text() for text in with_it.get_axes()[0].get_legend().get_texts()]
    assert "fitted model" in [text.get_text() for text in with_it.get_axes()[2].get_legend().get_texts()]
    assert len(with_it.get_axes()[1].lines) == len(without.get_axes()[1].lines) + 1
    with_it.draw_without_rendering()


@pytest.mark.parametrize(("distance", "words"), [(1.04, "lies outside W by 4 %"), (8.7, "lies 8.7 times outside W")])
def test_a_little_outside_is_said_in_percent(distance: float, words: str) -> None:
    found = FittedInEnvelope(np.ones(2), np.ones(2, dtype=complex), distance, 10.4, -6.0, 10.4, (), "Record more.")
    assert words in found.sentences()[0]


@pytest.fixture(scope="module")
def late():
    """An envelope of responses whose current comes ten milliseconds late."""
    plants = np.stack([f * rig(OMEGA) * np.exp(-0.01j * OMEGA) for f in (0.9, 1.0, 1.1)])
    return est.envelope(plants, omega=OMEGA, order_nominal=4, progress=False)


def test_dry_friction_is_spoken_of_where_the_model_has_it(late):
    for model, dry in ((MODEL, True), (MODEL.without("cart_coulomb"), False)):
        found = fitted_in_envelope(model, late)
        assert found.distance > 1
        assert ("dry friction" in found.sentences()[0]) == dry
        assert ("every condition has the dry friction" in found.remedy) == dry


def test_a_dead_time_of_the_fitted_model_takes_part(late):
    assert fitted_in_envelope(MODEL + InputDelay(0.01), late).distance < 1
