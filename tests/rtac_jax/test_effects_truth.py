"""Every effect of the catalogue against the virtual rig, which shares no code with it: other formulas, another integrator.

The truth is extrapolated from two step sizes, so that where it is smooth its own error is far below the tolerance.
"""

import itertools
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest

from estimators.study.truth import EFFECT_FIELD, FIELD_OF
from rtac_jax import RTAC, Experiment, RigidBody, effects, parameter, simulate
from rtac_jax.effects import CATALOGUE, Effect, Force
from rtac_jax.effects.gravity_tilt import STANDARD_GRAVITY
from rtac_jax.parameters import declarations
from rtac_jax.virtual_rig import Plan, Rig
from rtac_jax.virtual_rig._motion import integrate
from rtac_jax.virtual_rig._record import measure

CHANNELS = ("cart_position", "arm_velocity", "arm_angle")
SILENT = {"position_noise": 0.0, "velocity_noise": 0.0, "angle_noise": 0.0, "quantisation_bits": None, "encoder": True}
INERTIA, GRAVITY = 9.5e-5, 9.81 / STANDARD_GRAVITY
STIFFNESS, ROTOR, DAMPING = 0.5, 0.4, 2e-4  # of the flexible shaft
TWIST = np.sqrt(STIFFNESS / (INERTIA * ROTOR * (1 - ROTOR)))  # its frequency


def wave(cls: Any, size: float, phase: float, length: float) -> Effect:
    return cls(size * np.cos(phase), size * np.sin(phase), length)


# Effect by id, with the fields of the virtual rig that make it.
CASES: dict[str, tuple[dict[str, float], Effect]] = {
    "cart_coulomb": ({"cart_coulomb": 0.03}, effects.CartCoulomb(0.03)),
    "cart_stribeck": ({"cart_stribeck": 0.04}, effects.CartStribeck(0.04, 0.005)),
    "cart_quadratic_drag": ({"cart_quadratic_drag": 3.0}, effects.CartQuadraticDrag(3.0)),
    "cart_asymmetric_friction": ({"cart_asymmetry": 0.4}, effects.CartAsymmetricFriction(0.4)),
    "cubic_spring": ({"cubic_spring": 2e5}, effects.CubicSpring(2e5)),
    "quadratic_spring": ({"quadratic_spring": 900.0}, effects.QuadraticSpring(900.0)),
    "hysteretic_spring": ({"hysteresis_stiffness": 30.0}, effects.HystereticSpring(30.0, 1e-3)),
    "cart_presliding": (
        {"cart_coulomb": 0.0, "cart_presliding": 0.03, "cart_presliding_yield": 5e-4}, effects.CartPresliding(0.03, 5e-4)
    ),
    "force_offset": ({"force_offset": 0.05}, effects.ForceOffset(0.05)),
    "flexible_mode": ({"flexible_mass": 0.2, "flexible_damping": 0.05}, effects.FlexibleMode(0.2, 37.4, 0.05)),
    "end_stop": ({"end_stop_travel": 0.008, "end_stop_stiffness": 2e3}, effects.EndStop(2e3, 0.008)),
    "arm_coulomb": ({"arm_coulomb": 1e-3}, effects.ArmCoulomb(1e-3)),
    "arm_stribeck": ({"arm_stribeck": 1e-3}, effects.ArmStribeck(1e-3, 0.5)),
    "arm_presliding": ({"arm_presliding": 1e-3}, effects.ArmPresliding(1e-3, 0.02)),
    "arm_load_friction": ({"arm_load_friction": 0.2}, effects.ArmLoadFriction(0.2)),
    "arm_quadratic_drag": ({"arm_quadratic_drag": 6e-6}, effects.ArmQuadraticDrag(6e-6)),
    "cogging": ({"cogging_torque": 2e-3, "cogging_phase": 0.4}, wave(effects.Cogging, 2e-3, 0.4, 4.0)),
    "second_cogging": (
        {"second_cogging_torque": 2e-3, "second_cogging_phase": 0.4}, wave(effects.SecondCogging, 2e-3, 0.4, 8.0)
    ),
    "torque_ripple": (
        {"torque_ripple": 0.1, "torque_ripple_phase": 0.4}, wave(effects.TorqueRipple, 0.1, 0.4, 6.0)
    ),
    "cable_spring": ({"cable_stiffness": 1e-3, "cable_home": 0.5}, effects.CableSpring(1e-3, 5e-4)),
    "torque_offset": ({"current_offset": 0.02}, effects.TorqueOffset(0.02 * Rig.torque_constant)),
    "gravity_tilt": (
        {"tilt_along": 0.01, "tilt_across": 0.03}, effects.GravityTilt(GRAVITY * np.sin(0.01), GRAVITY * np.sin(0.03))
    ),
    "backlash": ({"backlash": 0.02}, effects.Backlash(0.02, 0.3)),
    "flexible_shaft": (
        {"shaft_stiffness": STIFFNESS, "rotor_share": ROTOR, "shaft_damping": DAMPING},
        effects.FlexibleShaft(INERTIA / STIFFNESS, ROTOR, 0.5 * DAMPING * TWIST / STIFFNESS, 1e5),
    ),
    "input_hold": ({}, effects.InputHold(1.0, 1.0)),
    "input_delay": ({"input_delay": 0.0083}, effects.InputDelay(0.0083)),
    "saturation": ({"saturation": 0.25}, effects.Saturation(4.0)),
    "current_lag": ({"current_lag": 0.007}, effects.CurrentLag(0.007)),
    "current_offset": ({"current_offset": 0.02}, effects.CurrentOffset(0.02)),
    "dead_zone": ({"dead_zone": 0.03}, effects.DeadZone(0.03)),
    "torque_droop": ({"torque_droop": 0.2}, effects.TorqueDroop(0.2)),
    "force_delay": ({"force_delay": 0.0083}, effects.ForceDelay(0.0083)),
    "force_lag": ({"force_lag": 0.007}, effects.ForceLag(0.007)),
    "force_saturation": ({"force_saturation": 0.2}, effects.ForceSaturation(5.0)),
    "force_dead_zone": ({"force_dead_zone": 0.03}, effects.ForceDeadZone(0.03)),
    "force_droop": ({"force_droop": 0.7}, effects.ForceDroop(0.7)),
    "tacho_gain": ({"tacho_gain": 1.03}, effects.TachoGain(0.03)),
    "tacho_ripple": (
        {"tacho_ripple": 0.02, "tacho_ripple_order": 3.0, "tacho_ripple_phase": 0.4},
        wave(effects.TachoRipple, 0.02, 0.4, 3.0),
    ),
    "tacho_bias": ({"tacho_bias": 0.2}, effects.TachoBias(0.2)),
    "tacho_lag": ({"tacho_lag": 0.01}, effects.TachoLag(0.01)),
    "lvdt_gain": ({"lvdt_gain": 1.03}, effects.LvdtGain(0.03)),
    "lvdt_offset": ({"lvdt_offset": 1e-4}, effects.LvdtOffset(1e-4)),
    "lvdt_nonlinearity": ({"lvdt_cubic": 200.0}, effects.LvdtNonlinearity(200.0)),
    "lvdt_ripple": (
        {"lvdt_ripple": 1e-4, "lvdt_ripple_phase": 0.4}, wave(effects.LvdtRipple, 1e-4, 0.4, Rig.lvdt_ripple_pitch)
    ),
    "tacho_delay": ({"tacho_delay": 0.006}, effects.TachoDelay(0.006)),
    "lvdt_lag": ({"lvdt_lag": 0.005}, effects.LvdtLag(0.005)),
    "channel_delay": ({"channel_delay": 0.006}, effects.ChannelDelay(0.006)),
    "encoder_gain": ({"encoder_gain": 1.03}, effects.EncoderGain(0.03)),
    "encoder_offset": ({"encoder_offset": 0.1}, effects.EncoderOffset(0.1)),
    "encoder_ripple": (
        {"encoder_ripple": 0.02, "encoder_ripple_order": 2.0, "encoder_ripple_phase": 0.4},
        wave(effects.EncoderRipple, 0.02, 0.4, 2.0),
    ),
    "encoder_lag": ({"encoder_lag": 0.01}, effects.EncoderLag(0.01)),
}  # fmt: skip
# Parameters that no field of the rig holds as they are, by the reason.
NO_FIELD = {
    "the rig has an amplitude and a phase": (
        "cogging.sine", "cogging.cosine", "second_cogging.sine", "second_cogging.cosine",
        "torque_ripple.sine", "torque_ripple.cosine", "tacho_ripple.sine", "tacho_ripple.cosine",
        "lvdt_ripple.sine", "lvdt_ripple.cosine",
        "encoder_ripple.sine", "encoder_ripple.cosine",
    ),
    "the rig has a factor": ("tacho_gain.error", "lvdt_gain.error", "encoder_gain.error"),
    "the rig has the limit": ("saturation.inverse_limit", "force_saturation.inverse_limit"),
    "the rig has the angle": ("cable_spring.torque",),
    "the rig has the current": ("torque_offset.offset",),
    "the rig has a stiffness and a viscous damping": (
        "flexible_shaft.compliance", "flexible_shaft.damping", "flexible_shaft.fastest",
    ),
    "a plan has it": ("input_hold.share", "input_hold.order"),
    "the rig's sensor is zeroed on a level plane": ("gravity_tilt.zeroed",),
}  # fmt: skip
IN_THE_PAPER = {"cart_viscous", "arm_viscous"}  # of every rig here

TOLERANCE = {
    "end_stop": 5e-6,  # a kink at each end leaves second order
    "channel_delay": 5e-4,  # Pade's approximation of a delay, where the motion begins
    "tacho_delay": 5e-4,  # the same
}
"""Largest error of an output as a fraction of its largest value; 1e-6 for the others."""

SAMPLES, SAMPLE_TIME = 160, 0.005
TIME = SAMPLE_TIME * np.arange(SAMPLES)
CURRENT = 0.3 * np.sin(11 * TIME) * (1 - np.exp(-TIME / 0.1)) + 0.15 * np.sin(31 * TIME) ** 3
FORCE = 0.3 * np.sin(9 * TIME)
START = (0.01, 0.0, 0.7, 4.0)
PLAN = Plan("a", "forced", SAMPLES * SAMPLE_TIME, SAMPLE_TIME, CURRENT, FORCE, *START)
EXPERIMENT = Experiment.of(
    "a", kind="forced", sample_time=SAMPLE_TIME, current=CURRENT, disturbance_force=FORCE, cart_position=TIME
)
BARE = RTAC.paper().without("cart_coulomb")


def truths(jobs: list[tuple[dict[str, float], Plan]], step: float) -> list[np.ndarray]:
    """Noise-free outputs [channel, sample] of rigs without dry friction, but for the fields given."""
    given = [
        (Rig(**{"cart_coulomb": 0.0, **SILENT, **fields}), plan, np.random.SeedSequence(0)) for fields, plan in jobs
    ]
    tracks = integrate(given, step)
    random = np.random.default_rng(0)
    shown = [measure(rig, track, random) for (rig, _, _), track in zip(given, tracks, strict=True)]
    return [np.stack([outputs[name] for name in CHANNELS]) for outputs in shown]


def extrapolated(jobs: list[tuple[dict[str, float], Plan]]) -> list[np.ndarray]:
    coarse, fine = truths(jobs, 2e-4), truths(jobs, 1e-4)
    return [(4 * b - a) / 3 for a, b in zip(coarse, fine, strict=True)]


@cache
def all_truths() -> dict[str, np.ndarray]:
    held = {"input_hold": replace(PLAN, played="foh")}
    jobs = [(fields, held.get(name, PLAN)) for name, (fields, _) in CASES.items()]
    return dict(zip(["plain", *CASES], extrapolated([({}, PLAN), *jobs]), strict=True))


def modelled(effect: Effect | None, substeps: int = 50) -> np.ndarray:
    found = simulate(BARE if effect is None else BARE + effect, [EXPERIMENT], start={"a": START}, substeps=substeps)[
        "a"
    ]
    return np.stack([getattr(found, name) for name in CHANNELS])


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Largest difference as a fraction of the largest value, of any channel."""
    return float(np.max(np.abs(one - other).max(axis=1) / np.abs(other).max(axis=1)))


def test_no_effect_of_the_catalogue_is_left_out():
    assert set(CASES) | IN_THE_PAPER == set(CATALOGUE)


def test_a_study_has_a_field_of_every_parameter_or_a_reason():
    """Without its field a study reports no bias of a parameter, and says nothing of that."""
    parameters = {f"{name}.{one}" for name, cls in CATALOGUE.items() for one in declarations(cls)}
    held = set(EFFECT_FIELD) | set(FIELD_OF) - set(declarations(RigidBody))
    excused = [name for several in NO_FIELD.values() for name in several]
    assert held.isdisjoint(excused)
    assert held | set(excused) == parameters


@pytest.mark.parametrize("effect_id", CASES)
def test_what_a_study_takes_for_true_is_what_the_model_has(effect_id):
    fields, effect = CASES[effect_id]
    rig = Rig(**fields)
    for name in declarations(effect):
        value = float(getattr(effect, name))
        field = {**FIELD_OF, **EFFECT_FIELD}.get(f"{effect_id}.{name}")
        if field is not None:
            assert getattr(rig, field) == pytest.approx(value, rel=1e-3), name  # an angle and its sine at most apart
        else:
            assert value not in fields.values(), f"one field holds {name}: it belongs into EFFECT_FIELD"


@pytest.mark.parametrize(("name", "field"), EFFECT_FIELD.items())
def test_the_rig_refuses_a_sign_that_the_model_refuses(name, field):
    effect, _, parameter_name = name.partition(".")
    if declarations(CATALOGUE[effect])[parameter_name].bounds[0] < 0.0:
        assert getattr(Rig(**{field: -1e-6}), field) == -1e-6
    else:
        with pytest.raises(ValueError, match=field):
            Rig(**{field: -1e-6})


@pytest.mark.parametrize("effect_id", [name for name in CASES if name != "backlash"])
def test_agrees_with_the_truth(effect_id):
    truth, plain = all_truths()[effect_id], all_truths()["plain"]
    tolerance = TOLERANCE.get(effect_id, 1e-6)
    assert apart(modelled(CASES[effect_id][1]), truth) < tolerance
    assert apart(truth, plain) > 40 * tolerance, "the effect should show"


@pytest.mark.parametrize("zeroed", [1.0, 0.6])
def test_tilt_agrees_with_the_truth_where_the_sensor_was_zeroed_at_rest(zeroed):
    """The model counts the cart's position from the sensor's zero."""
    rig, tilt = Rig(), 0.03
    sag = zeroed * rig.total_mass * GRAVITY * STANDARD_GRAVITY * np.sin(tilt) / rig.spring_stiffness
    shifted = replace(PLAN, initial_position=PLAN.initial_position + sag)
    truth = extrapolated([({"tilt_along": tilt, "lvdt_offset": -sag}, shifted)])[0]
    effect = effects.GravityTilt(GRAVITY * np.sin(tilt), 0.0, zeroed)
    assert apart(modelled(effect), truth) < 1e-6
    assert apart(modelled(effects.GravityTilt(effect.along, 0.0, 0.9 * zeroed)), truth) > 1e-3


def test_backlash_agrees_with_a_hard_contact():
    """The truth's contact yields a little, the less the smaller its step."""
    found, plain = modelled(CASES["backlash"][1], 100), all_truths()["plain"]
    errors = []
    for step in (2e-4, 2e-5):
        truth = truths([(CASES["backlash"][0], PLAN)], step)[0]
        shows = np.sqrt(np.mean((truth - plain) ** 2, axis=1))
        errors.append(np.sqrt(np.mean((found - truth) ** 2, axis=1)) / shows)
    assert np.all(errors[1] < 0.01), errors
    assert np.all(errors[1] < 0.3 * errors[0]), errors


def test_band_limited_input_declared_held():
    """The truth's spline is of fifth degree, the model's of third: they differ by what is not band-limited."""
    truth = extrapolated([({}, replace(PLAN, played="bl"))])[0]
    found, held = modelled(effects.InputHold(1.0, 3.0)), modelled(None)
    assert apart(found, truth) < 1e-4
    assert apart(held, truth) > 100 * apart(found, truth)
    half = modelled(effects.InputHold(0.5, 3.0))
    np.testing.assert_allclose(half, 0.5 * (held + found), atol=1e-3 * np.abs(held).max())


@pytest.mark.parametrize(
    ("declared", "other"),
    [
        pytest.param(*holds, marks=[pytest.mark.slow] * (holds not in {("zoh", "bl"), ("foh", "zoh"), ("bl", "foh")}))
        for holds in itertools.product(("zoh", "foh", "bl"), repeat=2)
    ],
)
def test_input_hold_is_the_other_declaration(declared, other):
    order = {"zoh": 0.0, "foh": 1.0, "bl": 3.0}[other]
    kinds = {"kind": "forced", "sample_time": SAMPLE_TIME, "current": CURRENT, "disturbance_force": FORCE}
    one, two = (Experiment.of("a", intersample=hold, cart_position=TIME, **kinds) for hold in (declared, other))
    with_effect = simulate(BARE + effects.InputHold(1.0, order), [one], start={"a": START}, substeps=4)["a"]
    as_declared = simulate(BARE, [two], start={"a": START}, substeps=4)["a"]
    for name in CHANNELS:
        # The two splines end differently, one fitted to its end, the other going on evenly: the last sample is left out.
        values, found = getattr(as_declared, name)[:-1], getattr(with_effect, name)[:-1]
        np.testing.assert_allclose(found, values, rtol=0, atol=2e-5 * np.abs(values).max())


@pytest.mark.slow
def test_input_hold_of_a_short_experiment_beside_a_long_one():
    kinds = {"kind": "forced", "sample_time": SAMPLE_TIME, "intersample": "zoh"}
    long = Experiment.of("long", cart_position=TIME, current=CURRENT, disturbance_force=FORCE, **kinds)
    short = long.cut(0, len(TIME) // 3, "short")
    start = {"short": START, "long": START}
    model = BARE + effects.InputHold(1.0, 3.0)
    beside = simulate(model, [short, long], start=start, substeps=4)
    for one in (short, long):
        alone = simulate(model, [one], start=start, substeps=4)[one.name]
        for name in CHANNELS:
            values = getattr(alone, name)
            np.testing.assert_allclose(
                getattr(beside[one.name], name), values, rtol=0, atol=1e-9 * np.abs(values).max()
            )


@pytest.mark.parametrize("delay", [0.0013, 0.005, 0.0075, 0.0214])
def test_delay_of_any_length(delay):
    truth = extrapolated([({"input_delay": delay}, PLAN)])[0]
    assert apart(modelled(effects.InputDelay(delay)), truth) < 2e-6
    # Even one step for a sample keeps the impulse and its moment.
    assert apart(modelled(effects.InputDelay(delay), 1), truth) < 1e-4


def test_delay_of_a_curved_input_follows_its_curve_and_without_delay_is_nothing():
    kinds = {"kind": "forced", "sample_time": SAMPLE_TIME, "current": CURRENT, "cart_position": TIME}
    curved = Experiment.of("a", intersample="bl", **kinds)

    def run(model, experiment):
        found = simulate(model, [experiment], start={"a": START}, substeps=1)["a"]
        return np.stack([getattr(found, name) for name in CHANNELS])

    plain = run(BARE, curved)
    assert apart(run(BARE + effects.InputDelay(0.0), curved), plain) < 1e-13
    truth = extrapolated([({"input_delay": 0.0083}, replace(PLAN, disturbance_force=None, intersample="bl"))])[0]
    assert apart(run(BARE + effects.InputDelay(0.0083), curved), truth) < 5e-6 < apart(plain, truth)


@pytest.mark.parametrize("hold", ["foh", "bl"])
@pytest.mark.parametrize("name", ["force_delay", "force_lag"])
def test_a_force_that_comes_late_does_so_with_its_curve(name, hold):
    late = {"force_delay": effects.ForceDelay(0.0083), "force_lag": effects.ForceLag(0.02)}[name]
    swift = 0.3 * np.sin(60 * TIME + 0.7)  # twenty samples a period, and not from zero
    given = Experiment.of(
        "a", kind="forced", sample_time=SAMPLE_TIME, disturbance_force=swift, cart_position=TIME, intersample=hold
    )

    def run(model):
        found = simulate(model, [given], start={"a": START}, substeps=1)["a"]
        return np.stack([getattr(found, name) for name in CHANNELS])

    size = {"force_delay": 0.0083, "force_lag": 0.02}[name]
    truth = extrapolated([({name: size}, replace(PLAN, current=None, disturbance_force=swift, intersample=hold))])[0]
    # A lag of the line through the ends of each interval leaves 9.7e-5 of a curved force.
    assert apart(run(BARE + late), truth) < 6e-5 < 0.01 * apart(run(BARE), truth)


@pytest.mark.slow
def test_delay_does_not_depend_on_how_many_powers_an_input_is_written_with():
    """A held current beside a band-limited one in another experiment, or behind another hold that is absent."""
    kinds = {"kind": "forced", "sample_time": SAMPLE_TIME, "current": CURRENT, "cart_position": TIME}
    held, curved = (Experiment.of(hold, intersample=hold, **kinds) for hold in ("zoh", "bl"))
    start = {"zoh": START, "bl": START}
    model = BARE + effects.InputDelay(0.0083)
    alone = simulate(model, [held], start=start, substeps=1)["zoh"]
    beside = simulate(model, [held, curved], start=start, substeps=1)["zoh"]
    behind = simulate(model + effects.InputHold(0.0, 3.0), [held], start=start, substeps=1)["zoh"]
    for name in CHANNELS:
        values = getattr(alone, name)
        for other in (beside, behind):
            np.testing.assert_allclose(getattr(other, name), values, rtol=0, atol=1e-13 * np.abs(values).max())


@pytest.mark.parametrize(
    "lag", [pytest.param(1e-7, marks=pytest.mark.slow), pytest.param(4e-4, marks=pytest.mark.slow), 0.002]
)
def test_lag_shorter_than_a_step(lag):
    """One step for a sample is enough, be the lag as short as it likes."""
    truth = extrapolated([({"current_lag": lag}, PLAN)])[0]
    assert apart(modelled(effects.CurrentLag(lag), 1), truth) < 1e-5
    # The truth follows its sensors with steps of 0.1 ms, so a lag that is much shorter is none.
    lags = {} if lag < 1e-4 else {"lvdt_lag": lag, "tacho_lag": lag, "encoder_lag": lag}
    truth = extrapolated([(lags, PLAN)])[0]
    model = BARE + effects.LvdtLag(lag) + effects.TachoLag(lag) + effects.EncoderLag(lag)
    found = simulate(model, [EXPERIMENT], start={"a": START}, substeps=1)["a"]
    assert apart(np.stack([getattr(found, name) for name in CHANNELS]), truth) < 2e-4


def test_user_adds_an_effect_in_a_few_lines():
    """An eddy-current brake, which the catalogue does not have."""

    class EddyBrake(Force):
        """An eddy-current brake on the arm."""

        id: ClassVar[str] = "eddy_brake"
        equation: ClassVar[str] = "-2 T x / (1 + x^2), x = theta' / w_c"
        source: ClassVar[str] = "Schieber, Proceedings of the IEE 122 (1975)"
        port: ClassVar[str] = "arm"
        nature: ClassVar[str] = "dissipative"
        torque: Any = parameter(symbol="T", unit="N m", meaning="peak torque", null=0.0, plausible=1e-3)
        velocity: Any = parameter(symbol="w_c", unit="rad/s", meaning="velocity of the peak", plausible=5.0)

        def force(self, motion, own):
            x = motion.arm_velocity / self.velocity
            return 0.0, -2 * self.torque * x / (1 + x**2)

    truth = extrapolated([({"eddy_torque": 2e-3, "eddy_velocity": 5.0}, PLAN)])[0]
    assert apart(modelled(EddyBrake(2e-3, 5.0)), truth) < 1e-6
    assert apart(truth, all_truths()["plain"]) > 0.05
