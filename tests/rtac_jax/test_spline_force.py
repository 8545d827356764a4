"""A learned force: its curve is what it says, and with the curve of a diagnosis the error falls, whatever is missing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hidden_effects import beyond_noise

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Motion, SplineForce
from rtac_jax.effects.spline_force import SHAPES, VARIABLES

# -- the effect ------------------------------------------------------------------------------------------------------

HEIGHTS = np.array([0.3, -0.2, 0.5, 0.1])
KNOTS = np.array([-0.01, 0.0, 0.01, 0.02])
FIELD = {
    "cart_position": "cart_position",
    "cart_velocity": "cart_velocity",
    "arm_angle": "arm_angle",
    "arm_velocity": "arm_velocity",
    "current": "current",
}


def motion(**values: float) -> Motion:
    """A motion with these values; what is not named is zero."""
    at = dict(cart_position=0.0, cart_velocity=0.0, arm_angle=0.0, arm_velocity=0.0, current=0.0) | values
    angle = at["arm_angle"]
    return Motion(
        jnp.asarray(at["cart_position"]), jnp.asarray(at["cart_velocity"]), jnp.asarray(angle),
        jnp.asarray(at["arm_velocity"]), jnp.sin(angle), jnp.cos(angle), jnp.asarray(at["current"]), rtac.RTAC.paper().body,
    )  # fmt: skip


def curve(variable: str = "cart_position", port: str = "cart", **rest: float) -> SplineForce:
    return SplineForce.over(variable, (KNOTS[0], KNOTS[-1]), port=port, shapes=HEIGHTS, amounts=np.ones(1), **rest)


@pytest.mark.parametrize("variable", FIELD)
@pytest.mark.parametrize("port", ["cart", "arm"])
@pytest.mark.parametrize("at", [-0.05, -0.01, -0.004, 0.0, 0.0125, 0.02, 0.3])
def test_a_force_is_the_curve_that_was_given(variable: str, port: str, at: float) -> None:
    force = curve(variable, port).force(motion(**{FIELD[variable]: at}), ())
    expected = np.interp(at, KNOTS, HEIGHTS)
    assert np.asarray(force[port == "arm"]) == pytest.approx(expected, abs=1e-12)
    assert np.asarray(force[port == "cart"]) == 0.0


def test_shapes_add_up_by_their_amounts() -> None:
    shapes = np.random.default_rng(0).standard_normal((3, 5))
    amounts = np.array([0.5, -2.0, 1.5])
    learned = SplineForce.over("cart_velocity", (-1.0, 1.0), port="cart", shapes=shapes, amounts=amounts)
    found = np.asarray(learned.force(motion(cart_velocity=0.3), ())[0])
    assert found == pytest.approx(np.interp(0.3, np.linspace(-1, 1, 5), amounts @ shapes), abs=1e-12)


def test_by_default_it_is_nothing_and_has_a_hat_for_each_of_six_knots() -> None:
    learned = SplineForce.over("arm_velocity", (-5.0, 5.0), port="arm")
    assert np.asarray(learned.force(motion(arm_velocity=2.0), ())[1]) == 0.0
    model = rtac.RTAC.paper() + learned
    third = model.with_values({"spline_force.amount_3": 2e-3}).effects[-1]
    assert isinstance(third, SplineForce)
    assert np.asarray(third.force(motion(arm_velocity=-1.0), ())[1]) == pytest.approx(2e-3)
    assert np.asarray(third.force(motion(arm_velocity=1.0), ())[1]) == pytest.approx(0.0, abs=1e-15)
    assert len([name for name in model.free if name.startswith("spline_force")]) == SHAPES


@pytest.mark.slow
def test_fewer_shapes_have_fewer_amounts_to_fit() -> None:
    """A detent at 3 mm, 1 mm wide, of which only the place is known: a bump to either side."""
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.005, duration=4.0, free=1, forced=2, rest=1)
    recording = virtual_rig.record(virtual_rig.Rig(detent_force=0.05), plans, seed=3)
    base = rtac.RTAC.from_rig(recording)
    bumps = 0.05 * np.array([[0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0]])
    model = base + SplineForce.over("cart_position", (0.0, 0.006), port="cart", shapes=bumps)
    assert set(model.free) - set(base.free) == {"spline_force.amount_1", "spline_force.amount_2"}
    before, after = (est.output_error(m, recording, progress=False) for m in (base, model))
    assert after.residual_std["cart_position"] < 0.3 * before.residual_std["cart_position"]


def test_an_angle_counts_by_its_place_in_the_turn() -> None:
    learned = SplineForce.over("arm_angle", (-np.pi, np.pi), port="arm", shapes=HEIGHTS, amounts=np.ones(1))
    here, turns_on = (np.asarray(learned.force(motion(arm_angle=a), ())[1]) for a in (0.7, 0.7 + 6 * np.pi))
    assert turns_on == pytest.approx(here, abs=1e-12)


@pytest.mark.parametrize("speed", [-0.2, -0.003, 0.003, 0.2])
def test_friction_opposes_the_motion_with_a_level_that_depends_on_the_place(speed: float) -> None:
    learned = curve("cart_position, against the motion", slow=0.003)
    level = np.interp(0.004, KNOTS, HEIGHTS)
    force = np.asarray(learned.force(motion(cart_position=0.004, cart_velocity=speed), ())[0])
    assert force == pytest.approx(-level * speed / np.hypot(speed, 0.003), rel=1e-9)


@pytest.mark.parametrize("at", [-0.004, 0.0135])
def test_derivatives_by_place_and_amount_are_slope_and_height(at: float) -> None:
    def force(place: jax.Array, amount: jax.Array) -> jax.Array:
        learned = rtac.RTAC.paper() + curve()
        effect = learned.with_values({"spline_force.amount_1": amount}).effects[-1]
        assert isinstance(effect, SplineForce)
        return effect.force(motion(cart_position=place), ())[0]  # type: ignore[arg-type]

    by_place, by_amount = jax.grad(force, argnums=(0, 1))(jnp.asarray(at), jnp.asarray(1.5))
    piece = np.searchsorted(KNOTS, at) - 1
    assert np.asarray(by_place) == pytest.approx(1.5 * np.diff(HEIGHTS)[piece] / 0.01, rel=1e-9)
    assert np.asarray(by_amount) == pytest.approx(np.interp(at, KNOTS, HEIGHTS), rel=1e-9)


def test_one_force_acts_on_many_trajectories() -> None:
    places = np.linspace(-0.02, 0.03, 7)
    many = motion()._replace(cart_position=jnp.asarray(places), cart_velocity=jnp.zeros(7))
    assert np.asarray(curve().force(many, ())[0]) == pytest.approx(np.interp(places, KNOTS, HEIGHTS), abs=1e-12)


def test_what_makes_no_curve_is_refused() -> None:
    good = dict(variable="cart_position", between=(-1.0, 1.0), port="cart")
    for change, words in (
        (dict(variable="temperature"), "is no variable"),
        (dict(port="floor"), "must be 'cart' or 'arm'"),
        (dict(between=(1.0, 1.0)), "is no range"),
        (dict(shapes=np.ones((7, 4))), "at most 6"),
        (dict(shapes=np.ones((2, 1))), "two knots at least"),
        (dict(shapes=np.ones((2, 4)), amounts=np.ones(3)), "give one for each"),
        (dict(slow=0.0), "positive speed"),
    ):
        with pytest.raises(ValueError, match=words):
            SplineForce.over(**(good | change))  # type: ignore[arg-type]
    assert "cart_position" in VARIABLES


# -- what it is for --------------------------------------------------------------------------------------------------

# Forces that no effect of the catalogue is, and what each depends on.
OUTSIDE = {
    "friction that grows along the way": (dict(friction_slope=2.0), "cart_position, against the motion"),
    "magnetic detent": (dict(detent_force=0.05), "cart_position"),
    "eddy-current brake": (dict(eddy_torque=1e-3), "arm_velocity"),
}
_RIVALS = ("cart_stribeck", "cubic_spring", "arm_quadratic_drag")


@pytest.fixture(scope="module")
def recordings() -> dict[str, rtac.Recording]:
    """One recording for each force, all of one shape, on rigs drawn around the paper's."""
    jobs = []
    for number, (hidden, _) in enumerate(OUTSIDE.values()):
        rig = dataclasses.replace(virtual_rig.Rig().drawn(50 + number), **hidden)
        plans = virtual_rig.standard_plans(seed=60 + number, sample_time=0.01, duration=6.0, free=3, forced=5, rest=1)
        jobs.append((rig, plans, 70 + number))
    return dict(zip(OUTSIDE, virtual_rig.record_many(jobs), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTSIDE)
def test_the_error_of_held_out_experiments_falls_by_half(recordings: dict[str, rtac.Recording], name: str) -> None:
    train, held_out = recordings[name].split(None)
    fit = est.output_error(rtac.RTAC.from_rig(recordings[name]), train, progress=False)
    offered = [CATALOGUE[c] for c in _RIVALS]
    found = est.diagnose(fit, train, candidates=offered, thorough=False, progress=False)
    assert found.verdict == "unknown", found
    assert "This was a quick diagnosis" in found.explanation
    assert found.curves[0].variable == OUTSIDE[name][1]
    better = est.output_error(fit.model + found.curves[0].effect(), train, from_model=True, progress=False)
    compared = est.compare([fit, better], held_out, labels=["base", "learned"])
    before, after = beyond_noise(compared, 0), beyond_noise(compared, 1)
    assert max(before.values()) > 0.5
    assert sum(after.values()) < 0.5 * sum(before.values()), (before, after)
