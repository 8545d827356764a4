"""The closed form where only one of total mass and arm inertia was measured, or neither: the rig's own scale, or a plain word."""

import dataclasses

import pytest
from scipy.stats import t as student

import estimators as est
import rtac_jax as rtac
from rtac_jax import RTAC, virtual_rig

RIG = dataclasses.replace(
    virtual_rig.Rig(),
    arm_inertia=1.9e-4,
    eccentric_moment=2e-3,
    total_mass=1.9,
    spring_stiffness=210.0,
    torque_constant=0.065,
)
TRUTH = {
    "total_mass": RIG.total_mass,
    "arm_inertia": RIG.arm_inertia,
    "spring_stiffness": RIG.spring_stiffness,
    "eccentric_moment": RIG.eccentric_moment,
    "torque_constant": RIG.torque_constant,
    "arm_viscous.positive": RIG.arm_viscous_positive,
    "arm_viscous.negative": RIG.arm_viscous_negative,
}


@pytest.fixture(scope="module")
def recording():
    plans = virtual_rig.standard_plans(seed=1, duration=5.0, free=3, forced=5)
    return virtual_rig.record(RIG, plans, seed=2)


def estimated(recording, known, *, fixed=(), **options):
    """Estimate with these constants alone; what is fixed beside them is known, too."""
    told = dataclasses.replace(recording, rig=known)
    model = RTAC.from_rig(told)
    model = model.with_values({name: TRUTH[name] for name in fixed}).fix(*fixed)
    return est.least_squares(model, told, **options)


@pytest.mark.parametrize("known", ["total_mass", "arm_inertia"])
def test_what_one_constant_leaves_open_the_coupling_tells(recording, known) -> None:
    found = estimated(recording, {known: TRUTH[known]}, weak=True)
    assert found.assumed == ()
    for name, true in TRUTH.items():
        if name == known:
            continue
        estimate = found.estimates[name]
        assert abs(estimate.value - true) < 4.5 * estimate.std, name
        assert estimate.std < 0.02 * true, name
    assert "is not estimated" not in str(found)
    filtered = estimated(recording, {known: TRUTH[known]})
    for name in ("torque_constant", "spring_stiffness"):
        assert filtered.estimates[name].value == pytest.approx(TRUTH[name], rel=0.03)
    assert filtered.weak is not None
    assert filtered.weak.estimates["torque_constant"].value == found.estimates["torque_constant"].value


@pytest.mark.parametrize(
    ("known", "fixed"),
    [("total_mass", "eccentric_moment"), ("arm_inertia", "eccentric_moment"), ("total_mass", "torque_constant")],
)
def test_a_known_product_me_or_motor_serves_as_well(recording, known, fixed) -> None:
    found = estimated(recording, {known: TRUTH[known]}, fixed=[fixed], weak=True)
    other = "arm_inertia" if known == "total_mass" else "total_mass"
    assert found.estimates[other].value == pytest.approx(TRUTH[other], rel=0.02)
    assert fixed not in found.estimates


def test_a_known_motor_alone_tells_both_scales(recording) -> None:
    found = estimated(recording, {}, fixed=["torque_constant"], weak=True)
    assert found.assumed == ()
    for name, true in TRUTH.items():
        if name != "torque_constant":
            assert found.estimates[name].value == pytest.approx(true, rel=0.02), name


def test_where_the_stiffness_or_the_motor_is_known_nothing_is_left_open(recording) -> None:
    by_spring = estimated(recording, {"arm_inertia": TRUTH["arm_inertia"]}, fixed=["spring_stiffness"], weak=True)
    assert by_spring.assumed == ()
    assert by_spring.estimates["total_mass"].value == pytest.approx(RIG.total_mass, rel=0.01)


def test_without_a_constant_the_printout_says_what_is_nothing_but_the_models_value(recording) -> None:
    found = estimated(recording, {}, weak=True)
    assert found.assumed == ("total_mass",)
    assert "total_mass" not in found.estimates
    text = str(found)
    assert "M+m is not estimated: 1.23 kg is the value that the model began with" in text
    assert "k, v, d, I+me^2, me, K_m, K_v1, K_v2 are in proportion to it" in text
    # What they are to each other is read from the data.
    for name, true in TRUTH.items():
        if name != "total_mass":
            assert found.estimates[name].value / 1.23 == pytest.approx(true / RIG.total_mass, rel=0.02), name


def test_without_a_constant_free_decays_tell_neither_scale(recording) -> None:
    free = recording.select([e.name for e in recording if e.kind != "forced"])
    found = estimated(free, {}, weak=True)
    assert found.assumed == ("total_mass", "arm_inertia")
    assert "k, v, d are in proportion to it" in str(found)


def test_free_decays_alone_do_not_tell_the_arms_inertia(recording) -> None:
    free = recording.select([e.name for e in recording if e.kind != "forced"])
    found = estimated(free, {"total_mass": RIG.total_mass}, weak=True)
    assert found.assumed == ("arm_inertia",)
    assert "I+me^2 is not estimated" in str(found)
    assert found.estimates["spring_stiffness"].value == pytest.approx(RIG.spring_stiffness, rel=0.01)


@pytest.mark.slow
def test_a_known_torque_constant_tells_the_inertia_of_an_arm_whose_cart_is_clamped() -> None:
    """Nothing is seen of a cart, so nothing of me either: the current's torque is the scale."""
    plans = [dataclasses.replace(plan, cart="clamped") for plan in virtual_rig.standard_plans(seed=3, free=0, forced=3)]
    recorded = virtual_rig.record(RIG, plans, seed=5)
    arm = [dataclasses.replace(e, outputs={"arm_velocity": e.outputs["arm_velocity"]}) for e in recorded]
    found = estimated(rtac.Recording(arm), {"torque_constant": RIG.torque_constant}, weak=True)
    assert found.assumed == ()
    for name in ("arm_inertia", "arm_viscous.positive", "arm_viscous.negative"):
        assert found.estimates[name].value == pytest.approx(TRUTH[name], rel=0.01)


@pytest.mark.slow
def test_a_cart_that_is_stuck_tells_no_eccentric_moment() -> None:
    """Its acceleration is that of the sensor's noise, and what would go with it is no estimate."""
    plans = virtual_rig.standard_plans(seed=3, free=0, forced=3)
    recorded = virtual_rig.record(dataclasses.replace(RIG, cart_coulomb=50.0), plans, seed=5)
    found = estimated(recorded, {"torque_constant": RIG.torque_constant}, weak=True)
    assert "eccentric_moment" not in found.estimates
    assert float(found.model["eccentric_moment"]) == float(RTAC.paper()["eccentric_moment"])
    assert found.estimates["arm_inertia"].value == pytest.approx(RIG.arm_inertia, rel=0.01)


def test_the_first_start_of_a_fit_knows_the_scale(recording) -> None:
    from estimators.closed_form.fit import starting_values

    told = dataclasses.replace(recording, rig={"total_mass": RIG.total_mass})
    start = starting_values(RTAC.from_rig(told), told)
    assert float(start["arm_inertia"]) == pytest.approx(RIG.arm_inertia, rel=0.05)
    assert float(start["torque_constant"]) == pytest.approx(RIG.torque_constant, rel=0.05)


def test_it_shows_itself_in_a_line_and_as_a_small_table(recording) -> None:
    found = estimated(recording, {}, weak=True)
    assert len(repr(found)) < 100
    assert repr(found).startswith("ClosedForm: 8 parameters in closed form, consistent by the paper's rule")
    assert "total_mass is the model&#x27;s own value" in found._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize("known", ["total_mass", "arm_inertia"])
def test_the_stated_deviation_of_the_scale_covers_the_truth(known) -> None:
    """Of 24 intervals of 95 % fewer than 20 cover with a probability of 0.2 %."""
    other = "arm_inertia" if known == "total_mass" else "total_mass"
    rigs = [dataclasses.replace(virtual_rig.Rig().drawn(seed), eccentric_moment=2e-3) for seed in range(500, 524)]
    plans = [
        virtual_rig.standard_plans(seed=600 + n, sample_time=0.005, duration=6.0, free=4, forced=8) for n in range(24)
    ]
    recordings = virtual_rig.record_many([(rig, plans[n], 700 + n) for n, rig in enumerate(rigs)])
    covered = 0
    for rig, one in zip(rigs, recordings, strict=True):
        told = dataclasses.replace(one, rig={known: getattr(rig, known)})
        found = est.least_squares(RTAC.from_rig(told), told, weak=True).estimates[other]
        covered += abs(found.value - getattr(rig, other)) < student.ppf(0.975, len(found.each) - 1) * found.std
    assert covered >= 20
