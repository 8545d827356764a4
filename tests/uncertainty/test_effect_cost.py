"""What a missing effect costs, on a rig whose second mode the first model does not know."""

import numpy as np
import pytest

import estimators as est
from rtac_jax import RTAC
from rtac_jax.effects import FlexibleMode
from rtac_jax.measurement import from_rest, harmonic_grid, multisine
from rtac_jax.virtual_rig import Plan, Rig, record

RIG = Rig(
    encoder=True, cart_coulomb=0.0, position_noise=2e-6, quantisation_bits=16, flexible_mass=0.12, flexible_frequency=37.4,
    flexible_damping=0.03,
)  # fmt: skip
SAMPLES, DT = 2000, 0.01


@pytest.fixture(scope="module")
def recording():
    """Four starting angles, a current that swings the arm by a fraction of a radian, over both modes."""
    lines = [int(n) for n in harmonic_grid("all", period=SAMPLES, sample_time=DT, band=(1.0, 8.0))]
    ratio = np.array(lines) / (SAMPLES * DT * 1.7)  # of the frequency to that of the first mode
    shape = np.minimum(ratio**2, 1 / ratio)
    plans = [
        Plan(
            f"condition_{n + 1}", "forced", SAMPLES * DT, DT,
            from_rest(multisine(samples=SAMPLES, sample_time=DT, rms=0.02, harmonics=lines, amplitudes=shape, seed=n)),
            initial_angle=0.3 * n - 0.5 + (np.pi if n % 2 else 0.0),
        )
        for n in range(4)
    ]  # fmt: skip
    return record(RIG, plans, seed=1, step=1e-3)


@pytest.fixture(scope="module")
def responses(recording):
    return est.frequency_responses(recording, band=(1.0, 8.0), half_width=20)


@pytest.fixture(scope="module")
def models(recording):
    """The rig's own numbers, without and with the mode."""
    rigid = RTAC.from_rig(recording).without("cart_coulomb")
    return rigid, rigid + FlexibleMode(RIG.flexible_mass, RIG.flexible_frequency, RIG.flexible_damping)


def falls(found):
    """Both the largest model error and gamma; the second by little, as the controller acts on the first mode."""
    assert found.effects == ("flexible_mode",)
    before, after = found.before.profile.max(), found.after.profile.max()
    assert after < 0.3 * before
    assert found.price.gamma["after"] < found.price.gamma["before"] - 0.001
    second = max(np.abs(np.linalg.eigvals(mode_matrix()))) ** 0.5
    assert found.gain[0] == pytest.approx(second, rel=0.03)


def mode_matrix():
    """Of the cart on its spring and the part on it, in plain NumPy."""
    cart, part = RIG.total_mass - RIG.flexible_mass, RIG.flexible_mass
    spring = part * RIG.flexible_frequency**2
    return np.diag([1 / cart, 1 / part]) @ np.array([[RIG.spring_stiffness + spring, -spring], [-spring, spring]])


@pytest.mark.slow
def test_knowing_the_mode_narrows_the_envelope_and_lowers_gamma(models, responses):
    rigid, flexible = models
    found = est.effect_cost(rigid, flexible, responses)
    falls(found)
    # The gap is that of the measured responses to two masses, or one, in plain NumPy: no model of the package in between.
    s = 1j * responses.frequency
    arm = RIG.arm_inertia * s**2 + 0.5 * (RIG.arm_viscous_positive + RIG.arm_viscous_negative) * s
    spring = RIG.flexible_mass * (RIG.flexible_frequency**2 + 2 * RIG.flexible_damping * RIG.flexible_frequency * s)
    for envelope, mass in ((found.before, 0.0), (found.after, RIG.flexible_mass)):
        hanging = mass * s**2 * spring / (RIG.flexible_mass * s**2 + spring)
        cart = (RIG.total_mass - mass) * s**2 + hanging + RIG.cart_viscous * s + RIG.spring_stiffness
        push = RIG.eccentric_moment * s**2
        nominal = -push * RIG.torque_constant / (cart * arm - push**2)
        gaps = np.abs(responses.response / nominal - 1)
        np.testing.assert_allclose(envelope.profile, gaps.max(axis=0), rtol=1e-6)
    text = str(found)
    assert "leaving out flexible_mode" in text
    assert f"gamma {found.price.gamma['before']:.3f}" in text
    assert "its gamma hardly depends on it" in text
    title = found.plot().get_suptitle()
    assert title.startswith("Knowing flexible_mode brings the largest model error from 1")


@pytest.mark.slow
def test_swapped_it_costs_instead(models, responses):
    rigid, flexible = models
    found = est.effect_cost(flexible, rigid, responses)
    assert found.effects == ()
    assert found.after.profile.max() > 3 * found.before.profile.max()
    assert found.price.gamma["after"] > found.price.gamma["before"] + 0.001


@pytest.mark.slow
def test_fits_show_what_the_truth_shows(models, recording, responses):
    """What is missing bends the first fit, and it still costs."""
    rigid, _ = models
    before = est.output_error(rigid, recording, from_model=True, progress=False)
    after = est.output_error(before.model + FlexibleMode(0.06, 35.0, 0.05), recording, from_model=True, progress=False)
    falls(est.effect_cost(before, after, responses))


def test_other_responses_are_refused(models, recording):
    raw = est.frequency_responses(recording, band=(1.0, 8.0), half_width=20, compensate=False)
    with pytest.raises(
        ValueError, match=r"condition_1 is from current to cart_position; give those from current times cos"
    ):
        est.effect_cost(*models, raw)
