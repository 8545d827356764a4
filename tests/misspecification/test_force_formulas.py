"""Formulas read off a missing force: three laws that are in no catalogue, from an integrator of the test's own."""

import numpy as np
import pytest

from estimators.misspecification.force_formulas import CurveEvidence, formulas_of
from rtac_jax.effects.formula_force import Term, formula_class

KNOTS, RUNS, SAMPLES, DT = 12, 6, 1500, 0.004
MASS, STIFFNESS, VISCOUS = 1.23, 132.6, 0.5543  # paper, section 4.2
NOISE = 0.02  # N, of the force that an innovation shows


def moved(law, seed, push=0.0):
    """Position and velocity of a driven oscillator with a hidden force, by Runge-Kutta steps; one column for each run."""
    random = np.random.default_rng(seed)
    phase, frequency = random.uniform(0, 6.28, (3, RUNS)), random.uniform(5.0, 15.0, (3, RUNS))
    state = np.stack([random.uniform(0.006, 0.015, RUNS), np.zeros(RUNS)])
    states = []

    def slope(time, x):
        drive = push * np.sum(np.sin(frequency * time + phase), axis=0)
        return np.stack([x[1], (drive - STIFFNESS * x[0] - VISCOUS * x[1] + law(*x)) / MASS])

    for n in range(SAMPLES):
        states.append(state)
        t = n * DT
        a = slope(t, state)
        b = slope(t + DT / 2, state + DT / 2 * a)
        c = slope(t + DT / 2, state + DT / 2 * b)
        d = slope(t + DT, state + DT * c)
        state = state + DT / 6 * (a + 2 * b + 2 * c + d)
    return np.moveaxis(np.array(states), 1, 0)


def evidence(law, which, seed, push=0.0):
    """What forces seen through noise say of the law as a function of one variable, with spring and damper fitted beside."""
    position, velocity = moved(law, seed, push)
    x = (position, velocity)[which]
    limit = np.max(np.abs(x))
    at = np.linspace(-limit, limit, KNOTS)
    place = (x.T.reshape(-1) - at[0]) / (at[1] - at[0])
    rows = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(KNOTS)))
    seen = law(position, velocity).T.reshape(-1)
    seen = seen + NOISE * np.random.default_rng(seed + 50).standard_normal(len(seen))
    basis, _ = np.linalg.qr(np.stack([position.T.reshape(-1), velocity.T.reshape(-1)], axis=1))
    rows, seen = (one - basis @ (basis.T @ one) for one in (rows / NOISE, seen / NOISE))
    folds = list(zip(np.split(rows, RUNS), np.split(seen, RUNS), strict=True))
    return at, CurveEvidence(np.stack([a.T @ a for a, _ in folds]), np.stack([a.T @ e for a, e in folds]))


def test_a_magnetic_detent_on_the_rail_is_read_as_a_sine():
    """-0.12 N sin(500 q): teeth every 13 mm."""
    at, known = evidence(lambda q, v: -0.12 * np.sin(500.0 * q), 0, seed=1)
    best = formulas_of("cart", "cart_position", at, known, 1e-4)[0]
    assert best.effect.terms == (Term("sine"),)
    shown = best.parameters
    assert shown["shape_1"].unit == "rad/m"
    assert shown["shape_1"].value == pytest.approx(500.0, rel=0.03)
    assert shown["coefficient_1"].value == pytest.approx(-0.12, rel=0.08)
    assert best.held_out > 100
    assert "sin(" in str(best)
    assert float(best.effect.coefficient_1) == shown["coefficient_1"].value


def test_a_drag_that_saturates_is_read_as_a_saturation():
    """-0.2 N tanh(v / 0.03 m/s): an eddy-current brake beyond its critical speed, beside the linear damper."""
    at, known = evidence(lambda q, v: -0.2 * np.tanh(v / 0.03), 1, seed=2, push=0.4)
    best = formulas_of("cart", "cart_velocity", at, known, 1e-4)[0]
    assert Term("saturation") in best.effect.terms
    place = 1 + best.effect.terms.index(Term("saturation"))
    assert best.parameters[f"coefficient_{place}"].value == pytest.approx(-0.2, rel=0.15)
    assert best.parameters[f"shape_{place}"].value == pytest.approx(0.03, rel=0.25)


def test_a_brake_whose_force_falls_beyond_its_critical_speed_is_read_as_a_peak():
    """-1.6 v / (1 + (v / 0.05 m/s)^2): an eddy-current brake, largest at 0.05 m/s, beside the linear damper."""
    at, known = evidence(lambda q, v: -1.6 * v / (1 + (v / 0.05) ** 2), 1, seed=5, push=0.4)
    best = formulas_of("cart", "cart_velocity", at, known, 1e-4)[0]
    assert best.effect.terms == (Term("peak"),)
    shown = best.parameters
    assert (shown["coefficient_1"].unit, shown["shape_1"].unit) == ("N/(m/s)", "m/s")
    assert shown["coefficient_1"].value == pytest.approx(-1.6, rel=0.15)
    assert shown["shape_1"].value == pytest.approx(0.05, rel=0.25)
    assert "q' / (1 + (q' / (" in best.text


def test_two_powers_are_read_as_two_powers_with_their_units():
    """A spring that is harder on one side, and at the fifth power: -40 N/m^2 of q^2 and -2e8 N/m^5 of q^5."""
    at, known = evidence(lambda q, v: -600.0 * q**2 - 3e8 * q**5, 0, seed=3)
    best = formulas_of("cart", "cart_position", at, known, 1e-4)[0]
    assert set(best.effect.terms) == {Term("power", 2), Term("power", 5)}
    for name, power, value in (("q^2", 2, -600.0), ("q^5", 5, -3e8)):
        shown = best.parameters[f"coefficient_{1 + best.effect.terms.index(Term('power', power))}"]
        assert abs(shown.value - value) < max(4 * shown.std, 0.1 * abs(value)), name
        assert shown.unit == f"N/m^{power}"


def test_the_simplest_that_says_nearly_all_is_told_beside_those_that_describe_the_rest():
    """A detent of teeth that are a little uneven: its main sine, though terms more gain a twentieth."""
    at, known = evidence(
        lambda q, v: -0.12 * np.sin(500.0 * q) + 0.02 * np.sin(900.0 * q) + 0.02 * np.cos(300.0 * q), 0, seed=1
    )
    *several, simplest = formulas_of("cart", "cart_position", at, known, 1e-4, most=3)
    assert min(len(one.effect.terms) for one in several) == 3
    assert simplest.effect.terms == (Term("sine"),)
    assert 0.9 * several[0].held_out <= simplest.held_out < several[0].held_out
    assert simplest.parameters["coefficient_1"].value == pytest.approx(-0.12, rel=0.1)


def test_where_nothing_is_missing_no_formula_is_worth_its_terms():
    at, known = evidence(lambda q, v: 0.0 * q, 0, seed=4)
    assert all(one.held_out < 5.0 for one in formulas_of("cart", "cart_position", at, known, 1e-4))


def test_the_effect_has_the_force_of_its_formula():
    import jax.numpy as jnp

    import rtac_jax as rtac
    from rtac_jax.effects._interface import Motion

    rtac.configure()
    kind = formula_class("arm", "arm_angle", (Term("cosine", 3), Term("power", 2)), 1e-3)
    assert kind is formula_class("arm", "arm_angle", (Term("cosine", 3), Term("power", 2)), 1e-3)
    effect = kind(coefficient_1=2e-3, coefficient_2=-1e-4)
    motion = Motion(0.0, 0.0, jnp.asarray(0.7), 0.0, 0.0, 0.0, 0.0, rtac.RTAC.paper().body)
    cart, torque = effect.force(motion, ())
    assert cart == 0
    assert float(torque) == pytest.approx(2e-3 * np.cos(2.1) - 1e-4 * 0.49)
    model = rtac.RTAC.paper() + effect
    assert {f"{kind.id}.coefficient_1", f"{kind.id}.coefficient_2"} <= set(model.free)
    assert model.parameters[f"{kind.id}.coefficient_2"].unit == "N m/rad^2"


def test_a_curve_of_which_two_directions_are_known_has_formulas_of_two_terms_at_most() -> None:
    """Three terms are not told apart then, though no two of them are alike."""
    at, known = evidence(lambda q, v: -900.0 * q * np.abs(q), 0, seed=2)
    information = np.sum(known.information, axis=0)
    _, directions = np.linalg.eigh(information)
    kept = directions[:, -2:] @ directions[:, -2:].T
    few = CurveEvidence(kept @ known.information @ kept, known.score @ kept)
    found = formulas_of("cart", "cart_position", at, few, 1e-4)
    assert found
    assert all(len(one.effect.terms) <= 2 for one in found)
