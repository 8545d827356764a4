"""All effects in one model, as the diagnosis runs them: absent they change nothing, and each has true derivatives."""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from rtac_jax import RTAC, Excitation, Experiment, Scales, effects, simulate
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.equations import state_at_start
from rtac_jax.parameters import declarations
from rtac_jax.simulation import advance, substeps_for, trajectories

SAMPLES, SAMPLE_TIME, SUBSTEPS = 150, 0.004, 4
TIME = SAMPLE_TIME * np.arange(SAMPLES)
CURRENT = 0.3 * np.sin(11 * TIME) + 0.15 * np.sin(31 * TIME)
EXPERIMENT = Experiment.of(
    "a", kind="forced", sample_time=SAMPLE_TIME, current=CURRENT, disturbance_force=0.3 * np.sin(9 * TIME),
    cart_position=TIME,
)  # fmt: skip
START = (0.01, 0.02, 0.7, 4.0)
SCALES = Scales(0.006, 0.06, 12.0, 0.23, 0.8, 0.02, 10.4, 1.23, SAMPLE_TIME)
ADDED = tuple(name for name in CATALOGUE if name not in RTAC.paper())


def example(effect_id: str) -> Effect:
    """Of plausible size, with a shape that shows."""
    found = CATALOGUE[effect_id].candidates(SCALES)
    return found[0] if effect_id in {"input_hold", "end_stop"} else found[len(found) // 2]


@cache
def together() -> tuple[RTAC, Excitation]:
    model = RTAC.paper()
    for effect_id in ADDED:
        shape = {
            n: float(getattr(example(effect_id), n))
            for n, d in declarations(example(effect_id)).items()
            if d.null is None
        }
        model = model + CATALOGUE[effect_id].absent(**shape)
    return model, Excitation.of([EXPERIMENT])


def names() -> tuple[str, ...]:
    return tuple(together()[0].parameters)


@eqx.filter_jit
def shown(values: Float[Array, " parameter"]) -> Float[Array, "sample output"]:
    model, excitation = together()
    placed = model.with_values(dict(zip(names(), values, strict=True)))
    start = state_at_start(placed, tuple(jnp.full(1, x) for x in START), excitation.first_current())
    found = trajectories(placed, start, excitation, samples=SAMPLES, substeps=jnp.asarray(SUBSTEPS))
    return found[:, :, 0]


@eqx.filter_jit
def slope(values: Float[Array, " parameter"], along: Float[Array, " parameter"]) -> Float[Array, "sample output"]:
    return jax.jvp(shown, (values,), (along,))[1]


def at(effect: Effect | None = None, amplitude: str = "", share: float = 1.0) -> np.ndarray:
    """Values of all parameters, with one effect present and one of its amplitudes changed."""
    model = together()[0]
    values = np.array([float(model[name]) for name in names()])
    for name in declarations(effect) if effect is not None else ():
        size = float(getattr(effect, name))
        values[names().index(f"{effect.id}.{name}")] = size * (share if name == amplitude else 1.0)
    return values


def test_absent_together_they_change_nothing():
    alone = simulate(RTAC.paper(), [EXPERIMENT], start={"a": START}, substeps=SUBSTEPS)["a"]
    found = np.asarray(shown(jnp.asarray(at())))
    for column, name in enumerate(("cart_position", "arm_velocity", "arm_angle")):
        values = getattr(alone, name)
        np.testing.assert_allclose(found[:, column], values, rtol=0, atol=1e-12 * np.abs(values).max())


@pytest.mark.parametrize(
    "effect_id",
    [pytest.param(i, marks=() if CATALOGUE[i].port in ("input", "actuator") else pytest.mark.slow) for i in ADDED],
)
def test_absent_beside_another_they_change_nothing(effect_id):
    """Or dry friction, which holds or lets go, makes another motion of a difference in the tenth digit."""
    effect = example(effect_id)
    alone = simulate(RTAC.paper() + effect, [EXPERIMENT], start={"a": START}, substeps=SUBSTEPS)["a"]
    found = np.asarray(shown(jnp.asarray(at(effect))))
    for column, name in enumerate(("cart_position", "arm_velocity", "arm_angle")):
        values = getattr(alone, name)
        np.testing.assert_allclose(found[:, column], values, rtol=0, atol=1e-12 * np.abs(values).max())


@pytest.mark.parametrize("effect_id", ADDED)
def test_derivative_is_the_limit_of_differences(effect_id):
    effect, small = example(effect_id), 1e-5
    for amplitude in effect.amplitudes():
        size = float(getattr(effect, amplitude))
        along = np.zeros(len(names()))
        along[names().index(f"{effect_id}.{amplitude}")] = size
        found = np.asarray(slope(jnp.asarray(at(effect)), jnp.asarray(along)))
        up, down = (np.asarray(shown(jnp.asarray(at(effect, amplitude, 1 + way * small)))) for way in (1, -1))
        expected = (up - down) / (2 * small)
        assert np.all(np.isfinite(found))
        for mine, theirs in zip(found.T, expected.T, strict=True):
            allowed = 1e-4 * np.sqrt(np.mean(theirs**2)) + 1e-7 * np.sqrt(np.mean(up**2))
            assert np.sqrt(np.mean((mine - theirs) ** 2)) < allowed, amplitude


@pytest.mark.parametrize("effect_id", ADDED)
def test_derivative_where_it_is_absent_is_finite(effect_id):
    for amplitude in CATALOGUE[effect_id].amplitudes():
        along = np.zeros(len(names()))
        along[names().index(f"{effect_id}.{amplitude}")] = 1.0
        assert np.all(np.isfinite(np.asarray(slope(jnp.asarray(at()), jnp.asarray(along)))))


@pytest.mark.parametrize(
    "effect",
    [
        effects.CurrentLag(1e-6), effects.ChannelDelay(1e-6), effects.InputDelay(1e-6), effects.HystereticSpring(1.0, 1e-7),
        effects.Backlash(1e-6, 0.3),
        *(
            pytest.param(effect, marks=pytest.mark.slow)
            for effect in (
                effects.TachoLag(1e-6), effects.LvdtLag(1e-6), effects.EncoderLag(1e-6),
                effects.FlexibleShaft(1e-9, 0.5, 0.05, 0.9 / SAMPLE_TIME),
            )
        ),
    ],
    ids=lambda effect: effect.id,
)  # fmt: skip
def test_nearly_absent_asks_for_no_small_steps(effect):
    model, excitation = RTAC.paper() + effect, together()[1]
    assert substeps_for(model, excitation) == substeps_for(RTAC.paper(), excitation)
    runs = [simulate(m, [EXPERIMENT], start={"a": START}, substeps=1)["a"] for m in (model, RTAC.paper())]
    for name in ("cart_position", "arm_velocity", "arm_angle"):
        one, other = (getattr(run, name) for run in runs)
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-3 * np.abs(other).max())


# -- effects that store energy only lose it ------------------------------------------------------------------------


def energies(effect: Effect, substeps: int = 20) -> np.ndarray:
    """Energy of the rig without friction of its own, released with the arm turning, and of what the effect stores."""
    model = RTAC(RTAC.paper().body, (effect,))
    free = Experiment.of("b", kind="free", sample_time=SAMPLE_TIME, cart_position=np.arange(500.0))
    found = simulate(model, [free], start={"b": (0.012, 0.0, 0.3, 12.0)}, substeps=substeps)["b"].states
    q, speed, angle, turn = (found[name] for name in ("cart_position", "cart_velocity", "arm_angle", "arm_velocity"))
    body = model.body
    total = np.asarray(body.energy(q, speed, angle, turn))
    inertia = float(body.arm_inertia)
    if isinstance(effect, effects.HystereticSpring):
        total = total + 0.5 * float(effect.stiffness) * found["hysteretic_spring.displacement"] ** 2
    else:
        twist, rate = found[f"{effect.id}.twist"], None
        rotor = float(effect.rotor) * inertia
        if isinstance(effect, effects.Backlash):
            rate = found["backlash.rate"]
        else:
            own = tuple(found[f"flexible_shaft.{name}"] for name in effect.states)
            rate = np.asarray(effect.read(effects.Outputs(q, turn, angle), own).arm_velocity) - turn
            total = total + 0.5 * inertia / float(effect.compliance) * twist**2
        total = total + rotor * turn * rate + 0.5 * rotor * rate**2
    return total


@pytest.mark.parametrize(
    "effect",
    [effects.HystereticSpring(30.0, 1e-3), effects.FlexibleShaft(2e-4, 0.4, 0.05, 1e4), effects.Backlash(0.05, 0.3)],
    ids=lambda effect: effect.id,
)
def test_stored_energy_only_falls(effect):
    found = energies(effect)
    assert np.all(np.diff(found) < 1e-6 * found[0])
    assert found[-1] < (1 - 1e-5) * found[0]


def test_shaft_that_is_made_slower_keeps_its_static_twist():
    """Under a steady torque the rotor leads by torque over stiffness, whatever the fastest twist that is followed."""
    compliance, body = 1e-5, RTAC.paper().body
    inertia, torque = float(body.arm_inertia), 0.1 * float(body.torque_constant)
    push = Experiment.of(
        "c",
        kind="forced",
        sample_time=SAMPLE_TIME,
        current=np.full(200, 0.1),
        cart_position=np.arange(200.0),
        cart="clamped",
    )
    for fastest in (1e4, 100.0):
        model = RTAC(body, (effects.FlexibleShaft(compliance, 0.4, 0.7, fastest),))
        found = simulate(model, [push], substeps=20)["c"].states
        # The shaft carries what accelerates the arm alone.
        expected = (1 - 0.4) * torque * compliance / inertia
        assert found["flexible_shaft.twist"][-1] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "ids",
    [(), ("current_lag", "flexible_mode", "cart_presliding", "tacho_lag"), ("backlash", "arm_coulomb")],
    ids=["the paper's", "with states in closed form and not", "with parts that hit each other"],
)
def test_stages_of_a_step_as_a_loop_are_those_one_by_one(ids):
    model = RTAC.paper()
    for effect_id in ids:
        model = model + example(effect_id)
    excitation = Excitation.of([EXPERIMENT])
    random = np.random.default_rng(8)
    start = state_at_start(model, tuple(jnp.full(1, x) for x in START), jnp.full(1, 0.2))
    state = tuple(x + jnp.asarray(1e-3 * random.standard_normal(1)) for x in start)
    powers = tuple(jnp.full(1, x) for x in (0.2, -0.1, 0.05, 0.02))

    @partial(jax.jit, static_argnames="unrolled")
    def later(state, *, unrolled):
        return jnp.stack(
            advance(model, state, powers, None, excitation, substeps=jnp.asarray(SUBSTEPS), unrolled=unrolled)
        )

    loop, one_by_one = later(state, unrolled=False), later(state, unrolled=True)
    assert np.any(np.abs(loop - jnp.stack(state)) > 1e-6)
    np.testing.assert_allclose(loop, one_by_one, rtol=1e-12, atol=1e-15)
