"""The virtual rig's effects, sensors, plans and draws, and what its recordings hold."""

from dataclasses import replace

import numpy as np
import pytest

from rtac_jax.virtual_rig import Plan, Rig, record, record_many, standard_plans
from rtac_jax.virtual_rig._motion import integrate

SEED = np.random.SeedSequence(0)
# A sensor that shows the same number all the time would be refused, so a trace of noise is left.
QUIET = {"position_noise": 1e-12, "velocity_noise": 1e-9, "quantisation_bits": None}
# Each hidden effect at a plausible value; what else it needs to show stands beside it.
EFFECTS = [
    {"cubic_spring": 1e5},
    {"quadratic_spring": 800.0},
    {"force_offset": 0.03},
    {"hysteresis_stiffness": 20.0},
    {"cart_presliding": 0.03},
    {"arm_presliding": 5e-4},
    {"flexible_mass": 0.2},
    {"cart_quadratic_drag": 2.0},
    {"cart_asymmetry": 0.3},
    {"cart_stribeck": 0.03},
    {"end_stop_travel": 0.009},
    {"arm_coulomb": 5e-4},
    {"arm_stribeck": 5e-4},
    {"arm_load_friction": 0.1},
    {"arm_quadratic_drag": 5e-6},
    {"tilt_along": 0.01},
    {"tilt_across": 0.02},
    {"cogging_torque": 1e-3},
    {"second_cogging_torque": 1e-3},
    {"torque_ripple": 0.1},
    {"cable_stiffness": 1e-3},
    {"backlash": 0.02},
    {"shaft_stiffness": 0.5},
    {"saturation": 0.2},
    {"input_delay": 0.004},
    {"current_lag": 0.005},
    {"current_offset": 0.005},
    {"dead_zone": 0.01},
    {"torque_droop": 0.2},
    {"force_delay": 0.004},
    {"force_lag": 0.005},
    {"force_saturation": 0.1},
    {"force_dead_zone": 0.03},
    {"force_droop": 2.0},
    {"tacho_bias": 0.2},
    {"tacho_gain": 1.03},
    {"tacho_lag": 0.01},
    {"lvdt_cubic": 200.0},
    {"lvdt_lag": 0.005},
    {"lvdt_gain": 1.03},
    {"lvdt_offset": 1e-4},
    {"lvdt_ripple": 1e-4},
    {"channel_delay": 0.005},
    {"tacho_delay": 0.005},
    {"tacho_ripple": 0.02},
    {"encoder_gain": 1.03},
    {"encoder_offset": 0.03},
    {"encoder_ripple": 0.01},
    {"encoder_lag": 0.005},
    {"force_noise": 5e-3},
    {"torque_noise": 1e-4},
    {"friction_slope": 0.8},
    {"detent_force": 0.1},
    {"vibration_force": 0.1},
    {"maxwell_stiffness": 20.0},
    {"eddy_torque": 1e-3},
    {"one_sided_spring": 30.0},
]
SHOWING = standard_plans(seed=2, duration=4.0, free=1, forced=1, rest=0)
PUSH = 0.15 * np.sin(9.0 * SHOWING[0].sample_time * np.arange(SHOWING[0].samples))
SHOWING = (*SHOWING, replace(SHOWING[0], name="pushed", kind="forced", disturbance_force=PUSH))


@pytest.fixture(scope="module")
def with_effects():
    """Plain outputs, and those with each effect, of one batch; no noise."""
    quiet = {**QUIET, "encoder": True, "angle_noise": 1e-12}
    rigs = [Rig(**quiet)] + [Rig(**quiet, **effect) for effect in EFFECTS]
    recordings = record_many([(rig, SHOWING, 1) for rig in rigs])
    return [
        [
            np.stack([e.outputs[name].values for name in ("cart_position", "arm_velocity", "arm_angle")])
            for e in recording
        ]
        for recording in recordings
    ]


@pytest.mark.parametrize("index", range(len(EFFECTS)), ids=[next(iter(effect)) for effect in EFFECTS])
def test_each_effect_shows(with_effects, index):
    plain, changed = with_effects[0], with_effects[index + 1]
    noise = np.array([2e-5, 0.05, 1e-3])
    largest = max((np.sqrt(np.mean((a - b) ** 2, axis=1)) / noise).max() for a, b in zip(plain, changed, strict=True))
    assert largest > 1.0


@pytest.mark.parametrize("effect", [{"arm_coulomb": 5e-4}, {"arm_stribeck": 5e-4}, {"arm_load_friction": 0.1}], ids=str)
def test_an_arm_that_rubs_does_so_where_no_other_of_its_batch_does(with_effects, effect):
    alone = record(Rig(**QUIET, **effect), SHOWING, seed=1)
    for experiment, among in zip(alone, with_effects[1 + EFFECTS.index(effect)], strict=True):
        np.testing.assert_allclose(experiment.outputs["arm_velocity"].values, among[1], atol=1e-9)


def test_absent_effects_change_nothing(with_effects):
    # Alone in its batch the plain rig runs none of the effects' code; among the others it runs all of it.
    alone = record(Rig(**QUIET), SHOWING, seed=1)
    for experiment, among in zip(alone, with_effects[0], strict=True):
        np.testing.assert_allclose(experiment.outputs["cart_position"].values, among[0], atol=1e-12)
        np.testing.assert_allclose(experiment.outputs["arm_velocity"].values, among[1], atol=1e-9)


def test_every_effect_is_tested_and_null_by_default():
    names = list(Rig.__dataclass_fields__)
    hidden = names[names.index("cubic_spring") : names.index("position_noise")]
    shapes = (
        "_yield",
        "_frequency",
        "flexible_damping",
        "_velocity",
        "stop_stiffness",
        "_order",
        "_phase",
        "_home",
    )
    shapes += ("_reference", "_position", "_width", "maxwell_damping", "shaft_damping", "_share", "_pitch", "_gap")
    assert {next(iter(effect)) for effect in EFFECTS} == {name for name in hidden if not name.endswith(shapes)}


def test_many_recordings_equal_single_ones_and_seeds_decide():
    plans = standard_plans(seed=0, duration=1.0, free=1, forced=2, repeats=1)
    jobs = [(Rig(force_noise=1e-3).drawn(n), plans, n) for n in (1, 2)]
    many = record_many(jobs)
    for (rig, _, seed), recording in zip(jobs, many, strict=True):
        single = record(rig, plans, seed=seed)
        assert dict(single.rig) == {"total_mass": rig.total_mass, "arm_inertia": rig.arm_inertia}
        for one, other in zip(single, recording, strict=True):
            for channel, signal in one.outputs.items():
                np.testing.assert_array_equal(signal.values, other.outputs[channel].values)
    first, again = many[0]["forced_1"].outputs, many[0]["repeat_1"].outputs
    assert np.any(first["cart_position"].values != again["cart_position"].values)
    other = record(jobs[0][0], plans, seed=3)["forced_1"].outputs
    assert np.any(first["cart_position"].values != other["cart_position"].values)


def test_sensors_noise_and_quantisation():
    rest = [Plan("rest", "rest", 20.0, 0.005)]
    recording = record(Rig(encoder=True), rest, seed=0, write_noise=True)
    outputs = recording["rest"].outputs
    for name, bit in (("cart_position", 0.04 / 4096), ("arm_velocity", 120 / 4096)):
        levels = outputs[name].values / bit
        np.testing.assert_allclose(levels, np.round(levels), atol=1e-9)
        assert np.std(outputs[name].values) == pytest.approx(outputs[name].noise_std, rel=0.05)
    assert np.std(outputs["arm_angle"].values) == pytest.approx(1e-3, rel=0.05)
    assert record(Rig(), rest, seed=0)["rest"].outputs["cart_position"].noise_std is None
    fast = Plan("fast", "free", 1.0, 0.005, initial_arm_velocity=80.0)
    assert record(Rig(), [fast], seed=0)["fast"].outputs["arm_velocity"].values.max() < 60.0
    coloured = record(Rig(noise_correlation=0.8, quantisation_bits=None), rest, seed=0)["rest"]
    noise = coloured.outputs["cart_position"].values
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.8, abs=0.05)
    assert np.std(noise) == pytest.approx(2e-5, rel=0.1)


def test_noisier_than_written():
    rest = [Plan("rest", "rest", 20.0, 0.005)]
    rig = Rig(noise_factor=2.0, noise_correlation=0.9, quantisation_bits=None, encoder=True)
    for signal in record(rig, rest, seed=0, write_noise=True)["rest"].outputs.values():
        assert np.std(signal.values) == pytest.approx(2 * float(signal.noise_std or 0), rel=0.15)
        assert np.corrcoef(signal.values[1:], signal.values[:-1])[0, 1] == pytest.approx(0.9, abs=0.03)


def test_standard_plans_stay_within_the_rig_and_show_it():
    plans = [plan for seed in range(4) for plan in standard_plans(seed=seed, repeats=1, sample_time=0.01)]
    assert [plan.kind for plan in plans[:14]] == ["free"] * 4 + ["forced"] * 9 + ["rest"]
    moving = [plan for plan in plans if plan.kind != "rest"]
    tracks = integrate([(Rig(), plan, SEED) for plan in moving], 5e-4)
    assert max(np.abs(track.position).max() for track in tracks) <= 0.0151
    assert max(np.abs(track.arm_velocity).max() for track in tracks) < 60.0
    assert max(np.abs(plan.current).max() for plan in moving if plan.current is not None) * 0.0804 < 0.1
    forced = [track for track, plan in zip(tracks, moving, strict=True) if plan.kind == "forced"]
    assert np.median([np.std(track.position[300:]) for track in forced]) > 1e-3
    assert np.median([np.ptp(track.angle) for track in forced]) > 2.0


def test_drawn_rigs():
    rig = Rig().drawn(4)
    assert rig == Rig().drawn(4) != Rig().drawn(5)
    assert 0.85 * 1.23 <= rig.total_mass <= 1.15 * 1.23
    assert Rig(cubic_spring=3.0).drawn(1, spread=0.0) == Rig(cubic_spring=3.0)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Rig(total_mass=0.0), "total_mass"),
        (lambda: Rig(cart_coulomb=-1.0), "cart_coulomb"),
        (lambda: Rig(cubic_spring=np.nan), "cubic_spring"),
        (lambda: Rig(eccentric_moment=0.1), "eccentric_moment"),
        (lambda: Rig().drawn(0, spread=1.0), "spread"),
        (lambda: Plan("a", duration=1.0, sample_time=0.1, current=np.zeros(9)), "current"),
        (lambda: Rig(rotor_share=1.0), "rotor_share"),
        (lambda: Plan("a", played="sinc"), "played"),  # pyright: ignore[reportArgumentType]
        (lambda: Plan("a", "fast"), "kind"),  # pyright: ignore[reportArgumentType]
        (lambda: record(Rig(), [], seed=0), "no plans"),
        (lambda: record(Rig(), [Plan("a"), Plan("a")], seed=0), "names"),
        (lambda: record(Rig(), [Plan("a")], seed=0, step=0.0), "step"),
        (lambda: standard_plans(seed=0, forced=0, repeats=1), "repeat"),
        (lambda: standard_plans(seed=0, duration=0.1), "short"),
    ],
)
def test_impossible_wishes_are_refused(make, word):
    with pytest.raises(ValueError, match=word):
        make()
