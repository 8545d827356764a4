"""The contract that every effect of the catalogue keeps, and that refuses what breaks it."""

import math
import re
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtac_jax import RTAC, Experiment, RigidBody, Scales, Simulation, effects, parameter, simulate
from rtac_jax._sincos import sincos
from rtac_jax.effects import CATALOGUE, Actuator, DryFriction, Effect, Force, Impact, Input, Motion, Sensor
from rtac_jax.parameters import declarations

IDS = tuple(CATALOGUE)
FORCES = tuple(name for name, cls in CATALOGUE.items() if issubclass(cls, Force))
NAMES = frozenset(
    {
        "cart_viscous",
        "cart_coulomb",
        "cart_stribeck",
        "cart_presliding",
        "cart_quadratic_drag",
        "cart_asymmetric_friction",
        "cubic_spring",
        "quadratic_spring",
        "hysteretic_spring",
        "force_offset",
        "flexible_mode",
        "end_stop",
        "arm_viscous",
        "arm_coulomb",
        "arm_stribeck",
        "arm_presliding",
        "arm_load_friction",
        "arm_quadratic_drag",
        "cogging",
        "second_cogging",
        "torque_ripple",
        "cable_spring",
        "gravity_tilt",
        "backlash",
        "flexible_shaft",
        "input_hold",
        "current_lag",
        "input_delay",
        "saturation",
        "force_delay",
        "force_lag",
        "force_saturation",
        "force_dead_zone",
        "force_droop",
        "dead_zone",
        "current_offset",
        "torque_droop",
        "torque_offset",
        "tacho_gain",
        "tacho_ripple",
        "tacho_bias",
        "tacho_lag",
        "lvdt_gain",
        "lvdt_ripple",
        "lvdt_offset",
        "lvdt_lag",
        "lvdt_nonlinearity",
        "encoder_gain",
        "encoder_ripple",
        "encoder_offset",
        "encoder_lag",
        "channel_delay",
        "tacho_delay",
    }
)
"""Names that the catalogue may use."""

PORTS = frozenset({"cart", "arm", "arm and cart", "actuator", "force drive", "input", "sensor"})
"""Parts of the rig by which a diagnosis decides whether an effect could be seen."""

SAMPLES, SAMPLE_TIME = 400, 0.005
TIME = SAMPLE_TIME * np.arange(SAMPLES)
EXPERIMENT = Experiment.of(
    "forced",
    kind="forced",
    sample_time=SAMPLE_TIME,
    current=0.25 * np.sin(9.0 * TIME) + 0.1 * np.cos(23.0 * TIME),
    disturbance_force=0.3 * np.sin(10.0 * TIME),
    cart_position=TIME,
)
START = [0.008, 0.02, 0.4, 9.0]
RIGID = ("cart_position", "cart_velocity", "arm_angle", "arm_velocity")


def run(model: RTAC) -> Simulation:
    return simulate(model, [EXPERIMENT], start={"forced": START}, substeps=8)["forced"]


@cache
def base(effect_id: str | None) -> tuple[RTAC, Simulation]:
    """The paper's model less the effect, and its trajectory."""
    model = RTAC.paper()
    if effect_id is not None and effect_id in model:
        model = model.without(effect_id)
    return model, run(model)


@cache
def scales() -> Scales:
    """Of the paper's rig in the experiment, as the diagnosis would find them."""
    body, found = RTAC.paper().body, base(None)[1]

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    current = rms(EXPERIMENT.inputs["current"].values)
    position = rms(found.cart_position)
    return Scales(
        position=position,
        velocity=rms(found.states["cart_velocity"]),
        arm_velocity=rms(found.arm_velocity),
        current=current,
        force=float(body.spring_stiffness) * position,
        torque=float(body.torque_constant) * current,
        frequency=float(body.natural_frequency()),
        mass=float(body.total_mass),
        sample_time=SAMPLE_TIME,
        applied_force=rms(EXPERIMENT.inputs["disturbance_force"].values),
    )


def change(effect: Effect) -> float:
    """Largest relative change of an output or a rigid state when the effect is added; infinite where not finite."""
    model, before = base(effect.id if effect.id in CATALOGUE else None)
    after = run(model + effect)
    pairs = [(after.states[name], before.states[name]) for name in RIGID]
    pairs += [(getattr(after, name), getattr(before, name)) for name in ("cart_position", "arm_velocity", "arm_angle")]
    assert set(after.states) >= set(before.states)
    worst = max(float(np.max(np.abs(new - old)) / np.max(np.abs(old))) for new, old in pairs)
    finite = all(np.all(np.isfinite(values)) for values in after.states.values())
    return worst if finite and math.isfinite(worst) else math.inf


def plausible(effect_id: str) -> tuple[Effect, ...]:
    return CATALOGUE[effect_id].candidates(scales())


def with_amplitude(effect: Effect, fraction: float) -> Effect:
    """The effect with its amplitudes moved from their plausible to their null value, all but this fraction."""
    values = {name: float(getattr(effect, name)) for name in declarations(effect)}
    for name in effect.amplitudes():
        null = declarations(effect)[name].null
        values[name] = null + fraction * (values[name] - null)
    return type(effect)(**values)


def is_unit(text: str) -> bool:
    """Whether a text is a product of powers of SI units, such as N m s/rad or kg m^2; 1 stands for no unit."""
    if text == "1":
        return True
    factor = r"(?:kg|rad|m|s|A|N|Hz)(?:\^[1-9])?"
    product = rf"{factor}(?:[ *]{factor})*"
    return re.fullmatch(rf"(?:1|{product})(?:/{product})?", text) is not None


@pytest.mark.parametrize("text", ["N m s/rad", "kg m^2", "1/m^2", "1", "N*s^2/m^2"])
def test_unit_check_accepts(text):
    assert is_unit(text)


@pytest.mark.parametrize("text", ["", "Newton", "m/s/s", "m^", "m  s", "mm", "/s", "m/"])
def test_unit_check_refuses(text):
    assert not is_unit(text)


def test_catalogue_holds_every_public_effect_once():
    public = [getattr(effects, name) for name in effects.__all__]
    final = [
        c for c in public if isinstance(c, type) and issubclass(c, Effect) and isinstance(getattr(c, "id", 0), str)
    ]
    # What was learned names no physics, so no diagnosis may offer it.
    final.remove(effects.SplineForce)
    assert sorted(cls.id for cls in final) == sorted(CATALOGUE)
    assert set(CATALOGUE.values()) == set(final)
    assert set(CATALOGUE) == NAMES


@pytest.mark.parametrize("effect_id", IDS)
def test_says_what_it_is(effect_id):
    cls = CATALOGUE[effect_id]
    assert cls.id == effect_id
    assert effects.effect_class(effect_id) is cls
    for text in (cls.equation, cls.source, cls.port, cls.__doc__):
        assert isinstance(text, str)
        assert len(text.strip()) > 2
    assert issubclass(cls, (Force, DryFriction, Impact, Actuator, Input, Sensor))
    if issubclass(cls, (Force, DryFriction, Impact)):
        assert cls.nature in {"dissipative", "conservative", "source"}
    assert cls.port in PORTS
    assert cls.acts_by_contact == issubclass(cls, Impact)
    assert all(is_unit(unit) for unit in cls.states.values())
    assert cls.amplitudes(), "nothing switches the effect off"
    assert set(cls.contains) <= set(CATALOGUE) - {effect_id}
    one_sided = {"s": "a lag or a delay acts later", "dissipative": "what takes energy out cannot give it"}
    for name in cls.amplitudes():
        if declarations(cls)[name].unit in one_sided or getattr(cls, "nature", "") in one_sided:
            assert declarations(cls)[name].bounds[0] == 0.0, name
    for name, declared in declarations(cls).items():
        assert is_unit(declared.unit), name
        assert declared.symbol.strip(), name
        assert len(declared.meaning.strip()) > 2, name
        assert declared.bounds[0] < declared.bounds[1], name
        if declared.null is not None:
            assert declared.bounds[0] <= declared.null <= declared.bounds[1], name


@pytest.mark.parametrize("effect_id", IDS)
def test_absent_changes_nothing(effect_id):
    cls = CATALOGUE[effect_id]
    example = plausible(effect_id)[0]
    shape = {name: float(getattr(example, name)) for name in declarations(cls) if name not in cls.amplitudes()}
    absent = cls.absent(**shape)
    assert all(getattr(absent, name) == declarations(cls)[name].null for name in cls.amplitudes())
    assert all(getattr(absent, name) == value for name, value in shape.items())
    assert change(absent) < 1e-12


@pytest.mark.parametrize("effect_id", IDS)
def test_candidates_show_and_vanish_smoothly(effect_id):
    found = plausible(effect_id)
    assert found
    for effect in found:
        for name, declared in declarations(effect).items():
            value = float(getattr(effect, name))
            assert math.isfinite(value), name
            assert declared.bounds[0] <= value <= declared.bounds[1], name
        if cannot_show(effect):
            assert change(effect) < 1e-12
        else:
            assert 1e-9 < change(effect) < math.inf
    able = [effect for effect in found if not cannot_show(effect)]
    middle = able[len(able) // 2]
    assert change(with_amplitude(middle, 1e-3)) < 0.05 * change(middle)


def cannot_show(effect: Effect) -> bool:
    """Whether this shape of an effect cannot act in the experiment: a stop out of reach, a hold that is declared."""
    if isinstance(effect, effects.EndStop):
        return float(effect.travel) > np.max(np.abs(base(None)[1].cart_position))
    return isinstance(effect, effects.InputHold) and float(effect.order) == 0.0


def motion_at(rigid: Any, current: Any = 0.0) -> Motion:
    return Motion(*rigid, *sincos(jnp.asarray(rigid[2])), current, RTAC.paper().body)


def random_motions(count: int) -> list[Motion]:
    random, size = np.random.default_rng(5), scales()
    spread = np.array([2 * size.position, 2 * size.velocity, 3.0, 2 * size.arm_velocity])
    return [motion_at(jnp.asarray(spread * random.standard_normal(4)), 0.3) for _ in range(count)]


@pytest.mark.parametrize(
    "effect_id", [name for name in FORCES if CATALOGUE[name].nature == "dissipative" and not CATALOGUE[name].states]
)
def test_dissipative_force_takes_energy(effect_id):
    """An effect with states may give back what it has stored; the energy of those is followed below."""
    for effect in plausible(effect_id):
        powers = []
        for motion in random_motions(50):
            on_cart, on_arm = effect.force(motion, ())
            powers.append(float(on_cart * motion.cart_velocity + on_arm * motion.arm_velocity))
        assert max(powers) <= 0
        assert min(powers) < 0


@pytest.mark.parametrize("effect_id", IDS)
def test_a_sensor_needs_the_channel_that_it_changes_and_nothing_else_needs_one(effect_id):
    cls = CATALOGUE[effect_id]
    if not issubclass(cls, Sensor):
        assert cls.needs_channel is None
        return
    before, after = base(None)[1], run(RTAC.paper() + plausible(effect_id)[0])
    names = ("cart_position", "arm_velocity", "arm_angle")
    changed = [name for name in names if not np.array_equal(getattr(after, name), getattr(before, name))]
    assert changed == [cls.needs_channel]


@pytest.mark.parametrize("effect_id", [name for name, cls in CATALOGUE.items() if issubclass(cls, DryFriction)])
def test_dry_friction_has_a_level(effect_id):
    for effect in plausible(effect_id):
        levels = np.array([effect.levels(motion, ()) for motion in random_motions(50)], dtype=float)
        assert levels.min() >= 0
        assert levels.max() > 0


@pytest.mark.parametrize("effect_id", [name for name in FORCES if CATALOGUE[name].nature == "conservative"])
def test_conservative_force_has_a_potential(effect_id):
    """It depends on position alone, and the work round a small circle vanishes."""
    motions = jnp.asarray([[float(x) for x in (*motion[:4], motion.current)] for motion in random_motions(20)])
    for effect in plausible(effect_id)[:5]:

        def force(values, effect=effect):
            on_cart, on_arm = effect.force(motion_at(values[:4], values[4]), ())
            return jnp.stack([jnp.asarray(on_cart, dtype=float), jnp.asarray(on_arm, dtype=float)])

        jacobians = np.asarray(jax.vmap(jax.jacfwd(force))(motions))
        assert not jacobians[:, :, [1, 3, 4]].any()
        np.testing.assert_allclose(jacobians[:, 0, 2], jacobians[:, 1, 0], rtol=1e-12, atol=0)


@pytest.mark.parametrize("effect_id", IDS)
def test_start_and_rate_follow_the_states(effect_id):
    effect = plausible(effect_id)[0]
    motion = motion_at(jnp.asarray(START), jnp.asarray(0.2))
    own = effect.start(motion)
    assert len(own) == len(effect.states)
    assert len(effect.rate(motion, own)) == len(effect.states)
    assert np.all(np.isfinite(np.array([*own, *effect.rate(motion, own)], dtype=float)))


def test_starts_in_equilibrium():
    """A flexible part moves with the cart, and a current starts at its command."""
    motion = motion_at(jnp.asarray(START), jnp.asarray(0.2))
    assert [float(x) for x in effects.FlexibleMode(0.1, 30.0, 0.02).start(motion)] == [0.0, START[1]]
    assert [float(x) for x in effects.CurrentLag(0.01).start(motion)] == [0.2]


class Magnet(Force):
    """A force that a user adds."""

    id: ClassVar[str] = "magnet"
    equation: ClassVar[str] = "-F_0 tanh(q / w)"
    source: ClassVar[str] = "a magnet beneath the table"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"
    strength: Any = parameter(symbol="F_0", unit="N", meaning="pull of the magnet", null=0.0, plausible=0.1)

    def force(self, motion, own):
        return -self.strength * jnp.tanh(motion.cart_position / 0.005), 0.0


def test_user_adds_an_effect():
    model = RTAC.paper() + Magnet(0.2)
    assert "magnet" in model
    assert model["magnet.strength"] == 0.2
    assert "magnet.strength" in model.free
    assert 1e-3 < change(Magnet(0.2)) < math.inf
    assert change(Magnet.absent()) < 1e-12
    # Near the origin it is a spring of strength / width.
    soft = RTAC(replace_stiffness(40.0), (Magnet(0.01),))
    stiff = RTAC(replace_stiffness(42.0))
    start = {"forced": [1e-6, 0.0, np.pi / 2, 0.0]}
    quiet = Experiment.of("forced", kind="free", sample_time=SAMPLE_TIME, cart_position=TIME, arm="locked")
    soft_run, stiff_run = (simulate(model, [quiet], start=start, substeps=4)["forced"] for model in (soft, stiff))
    np.testing.assert_allclose(soft_run.cart_position, stiff_run.cart_position, atol=1e-12)


def replace_stiffness(value: float) -> RigidBody:
    return eqx.tree_at(lambda body: body.spring_stiffness, RTAC.paper().body, jnp.asarray(value))


@pytest.mark.parametrize("effect_id", IDS)
def test_adding_twice_is_refused(effect_id):
    effect = plausible(effect_id)[0]
    model = base(effect_id)[0] + effect
    with pytest.raises(ValueError, match=f"already has {effect_id}"):
        model + effect


def test_larger_rig_has_larger_candidates():
    """What is plausible follows the scales: a force of a rig with twice the forces is twice as large."""
    doubled = replace(scales(), force=2 * scales().force, torque=2 * scales().torque)
    for effect_id in ("cart_viscous", "cart_coulomb", "cubic_spring", "arm_coulomb", "cogging"):
        name = CATALOGUE[effect_id].amplitudes()[0]
        ratio = getattr(CATALOGUE[effect_id].candidates(doubled)[0], name) / getattr(plausible(effect_id)[0], name)
        assert float(ratio) == pytest.approx(2.0)


def test_an_effect_shows_its_values_in_a_line():
    assert repr(CATALOGUE["cubic_spring"](5e4)) == "CubicSpring(stiffness=50000)"
    assert repr(CATALOGUE["cubic_spring"](np.ones(3))) == "CubicSpring(stiffness=3 values)"
    traced = []
    jax.jit(lambda x: traced.append(repr(CATALOGUE["cubic_spring"](x))) or x)(1.0)
    assert re.fullmatch(r"CubicSpring\(stiffness=\w+\)", traced[0])


@pytest.mark.parametrize("effect", ["flexible_shaft", "backlash"])
def test_where_an_arm_apart_from_its_rotor_has_its_friction_is_said(effect):
    assert (
        CATALOGUE[effect]
        .remark(CATALOGUE[effect], RTAC.paper().body)
        .startswith("The arm's friction is taken to sit on the arm: ")
    )
