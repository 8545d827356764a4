"""The model as an object: its parts, its parameters, and what it refuses."""

import numpy as np
import pytest

from rtac_jax import RTAC, Experiment, Recording, RigidBody
from rtac_jax.effects import CATALOGUE, Cogging, CubicSpring, CurrentLag, DeadZone, FlexibleMode, SplineForce, TachoBias

SAMPLES, SAMPLE_TIME = 50, 0.01
WAVE = np.sin(np.arange(SAMPLES))
BODY = {
    "total_mass": 1.23,
    "arm_inertia": 9.5e-5,
    "eccentric_moment": 1.06e-3,
    "spring_stiffness": 132.6,
    "torque_constant": 8.04e-2,
}
FRICTION = ("cart_viscous.coefficient", "cart_coulomb.level", "arm_viscous.positive", "arm_viscous.negative")


def experiment(name: str, *, current: bool = False, rest: bool = False, **holds: str) -> Experiment:
    return Experiment.of(
        name,
        kind="rest" if rest else "forced" if current else "free",
        sample_time=SAMPLE_TIME,
        current=WAVE if current else None,
        cart_position=1e-3 * WAVE,
        arm_velocity=WAVE,
        **holds,
    )


def recording(*experiments: Experiment, **rig: float) -> Recording:
    return Recording(experiments, rig)


def values(model: RTAC) -> dict[str, float]:
    return {name: float(model[name]) for name in model.parameters}


# -- composition ---------------------------------------------------------------------------------------------------


def test_paper_has_table_1():
    model = RTAC.paper()
    assert model.ids == ("cart_viscous", "cart_coulomb", "arm_viscous")
    assert values(model) == {**BODY, **dict(zip(FRICTION, (0.5543, 0.024, 1.39e-4, 1.49e-4), strict=True))}
    assert model.free == (*BODY, *FRICTION)
    assert tuple(model.states) == ("cart_position", "cart_velocity", "arm_angle", "arm_velocity")


def test_adding_makes_another_model():
    before = RTAC.paper().fix("total_mass").each_experiment("cart_coulomb.level")
    after = before + CubicSpring(2e4) + FlexibleMode(0.05, 37.4, 0.02)
    assert after.ids == ("cart_viscous", "cart_coulomb", "cubic_spring", "flexible_mode", "arm_viscous")
    assert before.ids == ("cart_viscous", "cart_coulomb", "arm_viscous")
    assert "cubic_spring" in after
    assert "cubic_spring" not in before
    assert float(after["cubic_spring.stiffness"]) == 2e4
    assert tuple(after.states)[4:] == ("flexible_mode.displacement", "flexible_mode.velocity")
    assert (after.fixed, after.per_experiment) == (before.fixed, before.per_experiment)


def test_what_is_added_takes_its_place_in_the_order_of_the_catalogue():
    """A lag and a dead zone follow each other as in the diagnosis that names them, whichever is added first."""
    lag, zone = CurrentLag(0.01), DeadZone(0.01)
    order = tuple(e for e in CATALOGUE if e in ("current_lag", "dead_zone"))
    for first, second in ((lag, zone), (zone, lag)):
        model = RTAC.paper() + first + second
        assert tuple(e for e in model.ids if e in order) == order
    learned = SplineForce.over("cart_position", (-0.01, 0.01), port="cart")
    assert (RTAC.paper() + learned + lag).ids[-1] == "spline_force"
    # Given whole, the order is the user's own.
    assert RTAC(RTAC.paper().body, (zone, lag)).ids == ("dead_zone", "current_lag")


def test_only_effects_can_be_added():
    with pytest.raises(TypeError):
        RTAC.paper() + 1.0
    with pytest.raises(TypeError, match="`best` of a diagnosis that names no effect is None"):
        RTAC.paper() + None


def test_without_takes_away_effect_and_its_marks():
    model = RTAC.paper().fix("total_mass", "cart_coulomb.level").each_experiment("cart_coulomb.level")
    less = model.without("cart_coulomb", "arm_viscous")
    assert less.ids == ("cart_viscous",)
    assert less.fixed == {"total_mass"}
    assert less.per_experiment == frozenset()
    assert (less + CubicSpring(0.0)).without("cubic_spring").ids == less.ids


def test_unknown_effect_cannot_be_taken_away():
    with pytest.raises(ValueError, match="no effect cogging; it has cart_viscous, cart_coulomb, arm_viscous"):
        RTAC.paper().without("cart_viscous", "cogging")


def test_one_effect_twice_is_refused():
    with pytest.raises(ValueError, match="already has cubic_spring; change its parameters with with_values"):
        RTAC.paper() + CubicSpring(1.0) + CubicSpring(2.0)


# -- parameters ----------------------------------------------------------------------------------------------------


def test_fix_and_release():
    model = RTAC.paper()
    held = model.fix("total_mass", "arm_viscous.positive")
    assert set(model.free) - set(held.free) == {"total_mass", "arm_viscous.positive"}
    assert held.release("total_mass").fixed == {"arm_viscous.positive"}
    assert held.release("total_mass", "arm_viscous.positive").free == model.free
    assert values(held) == values(model)


def test_shape_parameter_is_not_estimated():
    """The number of teeth of a motor is a grid to search, not a number to fit."""
    model = RTAC.paper() + Cogging(1e-3, 0.0, 4.0)
    assert "cogging.harmonic" in model.parameters
    assert "cogging.harmonic" not in model.free
    assert {"cogging.sine", "cogging.cosine"} <= set(model.free)


def test_each_experiment_has_its_own():
    model = RTAC.paper() + TachoBias(0.0)
    own = model.each_experiment("tacho_bias.bias")
    assert own.per_experiment == {"tacho_bias.bias"}
    assert own.each_experiment("cart_coulomb.level").per_experiment == {"tacho_bias.bias", "cart_coulomb.level"}
    assert own.free == model.free
    several = own.with_values({"tacho_bias.bias": np.array([0.1, 0.2, 0.3])})
    assert several["tacho_bias.bias"].shape == (3,)


def test_values_by_name_are_those_of_the_fields():
    model = (RTAC.paper() + CubicSpring(7.0)).with_values(
        {"arm_inertia": 3e-4, "cart_coulomb.level": np.array([0.1, 0.2])}
    )
    assert list(model.values) == list(model.parameters)
    for name, value in model.values.items():
        np.testing.assert_array_equal(value, model[name])
    assert float(model.values["cubic_spring.stiffness"]) == 7.0


def test_with_values_changes_only_what_is_named():
    model = RTAC.paper()
    other = model.with_values({"total_mass": 2.0, "arm_viscous.negative": 3e-4})
    assert values(other) == {**values(model), "total_mass": 2.0, "arm_viscous.negative": 3e-4}
    assert float(model["total_mass"]) == 1.23
    assert model.with_values({}) is model


@pytest.mark.parametrize("mark", ["fix", "each_experiment"])
def test_marking_an_unknown_parameter_is_refused(mark):
    with pytest.raises(ValueError, match=r"no parameter is called cart_coulomb\.slope") as caught:
        getattr(RTAC.paper(), mark)("total_mass", "cart_coulomb.slope")
    assert all(name in str(caught.value) for name in (*BODY, *FRICTION))


@pytest.mark.parametrize("name", ["mass", "cogging.sine", "cart_viscous", "cart_viscous.level"])
def test_unknown_parameter_is_refused_with_the_list(name):
    model = RTAC.paper()
    for ask in (lambda: model[name], lambda: model.with_values({name: 1.0})):
        with pytest.raises(KeyError, match=f"no parameter is called {name}; this model has") as caught:
            ask()
        assert all(known in str(caught.value) for known in (*BODY, *FRICTION))


def test_table_shows_every_parameter():
    model = (RTAC.paper() + TachoBias(0.0)).fix("total_mass")
    lines = str(model.with_values({"tacho_bias.bias": np.zeros(3)})).splitlines()
    assert len(lines) == len(model.parameters)
    for line, (name, declared) in zip(lines, model.parameters.items(), strict=True):
        assert line.startswith(f"{name} ")
        assert all(f" {text}" in line for text in (declared.symbol, declared.unit, declared.meaning))
        assert line.endswith("(fixed)") == (name == "total_mass")
        assert len(line) < 160
    assert " 1.23 kg " in lines[0]
    assert "3 values" in lines[-1]


# -- from a recording ----------------------------------------------------------------------------------------------


def test_from_rig_fixes_what_is_known():
    found = RTAC.from_rig(
        recording(experiment("free"), experiment("forced", current=True), total_mass=2.0, arm_inertia=1e-4)
    )
    assert found.fixed == {"total_mass", "arm_inertia"}
    assert values(found) == {**values(RTAC.paper()), "total_mass": 2.0, "arm_inertia": 1e-4}
    assert found.ids == RTAC.paper().ids


def test_from_rig_without_a_current_leaves_the_motor_alone():
    assert RTAC.from_rig(recording(experiment("free"))).fixed == {"torque_constant"}


def test_from_rig_with_the_arm_locked():
    """A rest tells nothing of the arm, though it is free there."""
    found = RTAC.from_rig(recording(experiment("a", arm="locked"), experiment("still", rest=True)))
    assert found.ids == ("cart_viscous", "cart_coulomb")
    assert found.fixed == {"arm_inertia", "eccentric_moment", "torque_constant"}
    assert set(found.free) == {"total_mass", "spring_stiffness", *FRICTION[:2]}


def test_from_rig_with_the_cart_clamped():
    found = RTAC.from_rig(recording(experiment("a", current=True, cart="clamped")))
    assert found.ids == ("arm_viscous",)
    assert found.fixed == {"total_mass", "eccentric_moment", "spring_stiffness"}


def test_from_rig_needs_one_experiment_in_which_a_part_moves():
    found = RTAC.from_rig(recording(experiment("a", arm="locked"), experiment("b", cart="clamped", current=True)))
    assert found.ids == RTAC.paper().ids
    assert found.fixed == frozenset()


def test_from_rig_refuses_an_unknown_constant():
    with pytest.raises(ValueError, match="/rig names cart_mass, which this model does not have; it has total_mass"):
        RTAC.from_rig(recording(experiment("free"), cart_mass=1.0))


# -- rigid body ----------------------------------------------------------------------------------------------------


def test_coupling_and_frequency_of_the_paper():
    body = RTAC.paper().body
    assert float(body.coupling()) == pytest.approx(1.06e-3 / np.sqrt(9.5e-5 * 1.23), rel=1e-12)
    assert float(body.coupling()) == pytest.approx(0.098, abs=5e-4)
    assert float(body.natural_frequency()) == pytest.approx(np.sqrt(132.6 / 1.23), rel=1e-12)
    assert float(body.natural_frequency()) == pytest.approx(10.38, abs=5e-3)


def test_energy_is_the_quadratic_form_of_the_mass_matrix():
    random = np.random.default_rng(0)
    for q, v, angle, w in random.standard_normal((20, 4)) * [0.01, 0.1, 3.0, 20.0]:
        exchange = BODY["eccentric_moment"] * np.cos(angle)
        matrix = np.array([[BODY["total_mass"], exchange], [exchange, BODY["arm_inertia"]]])
        expected = 0.5 * np.array([v, w]) @ matrix @ np.array([v, w]) + 0.5 * BODY["spring_stiffness"] * q**2
        assert float(RigidBody(**BODY).energy(q, v, angle, w)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", ["total_mass", "arm_inertia", "spring_stiffness", "torque_constant"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_body_refuses_what_is_not_positive(name, value):
    if (name, value) == ("spring_stiffness", 0.0):  # a slide
        assert float(RigidBody(**{**BODY, name: value}).natural_frequency()) == 0.0
        return
    with pytest.raises(ValueError, match=rf"{name} is .*, but must be positive"):
        RigidBody(**{**BODY, name: value})


@pytest.mark.parametrize("factor", [1.0, 2.0, -2.0, np.nan])
def test_body_refuses_a_singular_mass_matrix(factor):
    limit = np.sqrt(BODY["total_mass"] * BODY["arm_inertia"]) * (1 + 1e-9)
    with pytest.raises(ValueError, match=r"eccentric_moment is .* not positive definite"):
        RigidBody(**{**BODY, "eccentric_moment": factor * limit})
    RigidBody(**{**BODY, "eccentric_moment": 0.999 * limit})
    RigidBody(**{**BODY, "eccentric_moment": 0.0})
