"""A user's own effect with a fault: which effect, which method, which line, what is wrong, and the usual mend."""

import importlib.util
import re
import sys

import jax
import jax.numpy as jnp
import pytest
from command_line import call, refused
from small_experiments import forced, free

import estimators as est
import rtac_jax
from estimators.cli.own_effects import with_own
from rtac_jax import RTAC
from rtac_jax.effect_contract import require_working
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Recording

OWN = """
import math

import jax.numpy as jnp
import numpy as np

from rtac_jax import parameter
from rtac_jax.effects import Actuator, DryFriction, Force, Sensor


class Magnet(Force):
    id, equation, source, port, nature = "magnet", "-k q", "own rig", "cart", "conservative"
    states = {}
    k: object = parameter(symbol="k", unit="N/m", meaning="stiffness", null=0.0, plausible=1.0)

    def force(self, motion, own):
        x = motion.cart_position
        return -self.k * x, 0.0
"""
LINE = "return -self.k * x, 0.0"
FORCE = r"effect magnet: force \(mine\.py, line 18\) "
FAULTS = {
    "text": (
        'return "much", 0.0',
        "effect magnet: force returns the value 'much' where one number for each trajectory",
    ),
    "nothing": ("pass", "effect magnet: force returns one NoneType; return a tuple of 2: on the cart, on the arm"),
    "one": ("return -self.k * x", "effect magnet: force returns one .*; return a tuple of 2"),
    "shape": ("return -self.k * jnp.ones(7), 0.0", r"effect magnet: force returns an array of shape \(7,\) and type"),
    "three": (
        "return -self.k * jnp.arange(3.0), 0.0",
        r"effect magnet: force returns an array of shape \(3,\) .* \(shape \(4,\)",
    ),
    "matrix": ("return -self.k * x[:, None], 0.0", r"effect magnet: force returns an array of shape \(3, 1\) and type"),
    "truth": ("return x > 0, 0.0", r"effect magnet: force returns an array of shape \(3,\) and type bool"),
    "numpy": ("return -self.k * np.sin(x), 0.0", FORCE + r"calls NumPy .*; use jax.numpy \(jnp\) in place of numpy"),
    "math": ("return -self.k * math.sin(x), 0.0", FORCE + r"turns .*; use jnp\.sin instead of math\.sin"),
    "float": ("return float(self.k), 0.0", FORCE + r"turns .*no float\(\)"),
    "if": ("return (1.0 if x > 0 else 0.0), 0.0", FORCE + r"decides with a Python if.*; use jnp\.where instead of if"),
    "if parameter": ("return (1.0 if self.k > 0 else 0.0), 0.0", FORCE + r"decides .*; use jnp\.where instead of if"),
    "zero": ("return 1 / 0, 0.0", FORCE + r"divides by zero; keep the divisor away from 0"),
    "writes": ("x[0] = 1.0; return x, 0.0", FORCE + r"writes into an array; use x\.at\[i\]\.set"),
    "exit": ("exit()", FORCE + r"calls exit\(\); raise an error instead"),
    "interrupts": ('raise BaseException("no")', FORCE + "fails: BaseException: no; mend it"),
    "key": ("raise KeyError(x)", FORCE + "fails: KeyError: a value that is known only later; mend it"),
    "append": (
        "x.append(1)",
        FORCE + "fails: AttributeError: a value that is known only later has no attribute append",
    ),
    "one array": ("return x", "effect magnet: force returns one array; return a tuple of 2"),
    "zero motion": (
        "return -self.k / x, 0.0",
        "effect magnet: force is no number where nothing moves .*; keep what divides or stands under a root away from 0",
    ),
    "steep": (
        "return -self.k * jnp.sqrt(jnp.abs(x)), 0.0",
        "effect magnet: the slope of force is no number where nothing moves",
    ),
    "name": ("return motion.position, 0.0", FORCE + r"fails: AttributeError: .*no attribute 'position'.*--debug"),
}
SIZE = "plausible=1.0"
ELSEWHERE = {
    "plausible fails": (SIZE, "plausible=lambda scales: scales.mass / 0", r"plausible of k \(mine\.py, line 14\) div"),
    "plausible text": (SIZE, 'plausible=lambda scales: "big"', "effect magnet: plausible of k returns 'big'; return a finite"),
    "plausible nan": (SIZE, 'plausible=float("nan")', "effect magnet: plausible of k returns nan; return a finite number"),
    "plausible name": (SIZE, "plausible=lambda scales: scales.size", r"plausible of k \(mine\.py, line 14\) fails: AttributeError"),
    "no id": ("id, equation, source, port, nature = \"magnet\",", "equation, source, port, nature =", "Magnet has no id"),
    "odd id": ('"magnet"', '"my magnet"', "has the id 'my magnet'; use letters"),
    "states a number": ("states = {}", "states = 1", "effect magnet: states is 1; give a dictionary"),
    "states of numbers": ("states = {}", 'states = {1: "m"}', "effect magnet: states is .*; give a dictionary"),
    "odd port": ('"cart"', '"wheel"', "effect magnet: port is 'wheel'; use one of cart, arm, arm and cart"),
    "state without start": ("states = {}", 'states = {"z": "m"}', "effect magnet: start returns 0 value"),
    "sensor": (
        "def force(self, motion, own):", "def read(self, outputs, own):\n        return 1.0\n\n    def force(self, motion, own):",
        "effect magnet: read returns one float; return a tuple of 3: cart_position, arm_velocity, arm_angle",
    ),
    "mass": ("def force(self", 'def cart_mass(self):\n        return "1 kg"\n\n    def force(self', "cart_mass returns the value"),
}  # fmt: skip


def written(tmp_path, text):
    (tmp_path / "mine.py").write_text(text)
    return tmp_path / "mine.py"


def test_what_is_right_passes(tmp_path):
    assert [c.id for c in with_own(written(tmp_path, OWN))] == [*CATALOGUE, "magnet"]


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=CATALOGUE)
def test_every_effect_of_the_catalogue_keeps_the_contract(effect):
    require_working(effect)


@pytest.mark.parametrize(("line", "said"), FAULTS.values(), ids=FAULTS)
def test_a_fault_in_a_method_is_named_with_its_mend(tmp_path, line, said):
    with pytest.raises(ValueError, match=said) as caught:
        with_own(written(tmp_path, OWN.replace(LINE, line)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("old", "new", "said"), ELSEWHERE.values(), ids=ELSEWHERE)
def test_a_fault_elsewhere_is_named_with_its_mend(tmp_path, old, new, said):
    assert old in OWN
    with pytest.raises(ValueError, match=said) as caught:
        with_own(written(tmp_path, OWN.replace(old, new)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fit", [est.output_error, est.prediction_error_nonlinear])
@pytest.mark.parametrize("fault", ["text", "shape", "numpy", "math", "if", "zero"])
def test_a_fault_in_an_effect_of_the_model_is_named_before_a_fit(tmp_path, monkeypatch, fit, fault):
    """From Python, too, where an instance is added to the model."""
    line, said = FAULTS[fault]
    recording = Recording((free(), forced()), {"total_mass": 1.23, "arm_inertia": 9.5e-5})
    model = RTAC.from_rig(recording) + made(tmp_path, monkeypatch, OWN.replace(LINE, line))(1e3)
    with pytest.raises(ValueError, match=said) as caught:
        fit(model, recording, progress=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "call_it",
    [
        lambda model: rtac_jax.simulate(model, forced()),
        lambda model: rtac_jax.simulate_inputs(model, samples=200, sample_time=5e-3),
        rtac_jax.linearise,
    ],
    ids=["simulate", "simulate_inputs", "linearise"],
)
@pytest.mark.parametrize("fault", ["text", "shape", "numpy", "math", "if", "zero"])
def test_a_fault_in_an_effect_of_the_model_is_named_before_it_is_simulated(tmp_path, monkeypatch, call_it, fault):
    line, said = FAULTS[fault]
    model = RTAC.paper() + made(tmp_path, monkeypatch, OWN.replace(LINE, line))(1e3)
    with pytest.raises(ValueError, match=said):
        call_it(model)


def test_a_batch_and_a_derivative_by_an_effect_of_ones_own_are_computed(tmp_path, monkeypatch):
    model = RTAC.paper() + made(tmp_path, monkeypatch, OWN)(1e3)

    def last(stiffness):
        changed = model.with_values({"magnet.k": stiffness})
        return rtac_jax.simulate_inputs(
            changed, samples=50, sample_time=5e-3, start=(0.01, 0.0, 0.0, 0.0)
        ).cart_position[-1]

    several = jax.vmap(last)(jnp.array([0.0, 1e3]))
    assert float(several[1]) == pytest.approx(float(last(1e3)), rel=1e-12)
    assert float(jax.grad(last)(1e3)) != 0.0


def test_an_effect_without_an_id_is_refused_where_it_is_added(tmp_path, monkeypatch):
    old, new, _ = ELSEWHERE["no id"]
    effect = made(tmp_path, monkeypatch, OWN.replace(old, new))(1e3)
    with pytest.raises(ValueError, match="Magnet has no id, by which its parameters are named"):
        RTAC.paper() + effect


MODEL = RTAC.paper()
WITHOUT_NUMBER = {  # what is said of it, and the model
    "spring_stiffness is nan; give it a finite number": MODEL.with_values({"spring_stiffness": float("nan")}),
    "arm_coulomb.level is inf; give it a finite number": MODEL + CATALOGUE["arm_coulomb"](float("inf")),
}
SEVERAL = MODEL + CATALOGUE["arm_coulomb"]([1e-4, 2e-4])


@pytest.mark.parametrize(
    "call_it", [rtac_jax.simulate, est.output_error, est.prediction_error_nonlinear, est.least_squares, est.compare]
)
@pytest.mark.parametrize("said", WITHOUT_NUMBER)
def test_a_value_that_is_no_number_is_named(call_it, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        call_it(WITHOUT_NUMBER[said], Recording((free(), forced())))


@pytest.mark.parametrize("call_it", [est.output_error, est.prediction_error_nonlinear, est.least_squares, est.compare])
def test_several_values_are_of_a_parameter_that_each_experiment_has(call_it):
    with pytest.raises(
        ValueError, match=r"arm_coulomb\.level has 2 values; give it one, or let each experiment have its own"
    ):
        call_it(SEVERAL, Recording((free(), forced())))


def made(tmp_path, monkeypatch, text):
    """Return the class of a file, as a script has it that imports it."""
    spec = importlib.util.spec_from_file_location("mine", written(tmp_path, text))
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "mine", module)
    spec.loader.exec_module(module)
    return module.Magnet


@pytest.mark.parametrize("before", [True, False])
def test_the_command_line_keeps_the_traceback_for_those_who_ask(tmp_path, before, monkeypatch):
    monkeypatch.setattr("estimators.output_error", lambda *_, **__: None)
    Recording((free(), forced()), {"total_mass": 1.23}).save(tmp_path / "rig.h5")
    mine = written(tmp_path, OWN.replace(LINE, FAULTS["numpy"][0]))
    arguments = ["diagnose", tmp_path / "rig.h5", "--effects", mine]
    refused(call(*arguments), 2, "magnet", "in place of numpy")
    told = call(*(["--debug", *arguments] if before else [*arguments, "--debug"]))
    assert told.exit_code == 2
    assert "Traceback" in told.stderr
    assert "np.sin(x)" in told.stderr
    assert "in place of numpy" in told.stderr.splitlines()[-1]
    refused(call(*arguments), 2, "magnet")  # the next command is not asked for one
