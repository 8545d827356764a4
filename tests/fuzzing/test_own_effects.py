"""A user's own effects with faults in any place: offered, or refused with the effect, the method and the mend."""

import pytest
from fuzz import fuzz, outcome, sizes
from hypothesis import strategies as st

from estimators.cli.own_effects import with_own

TEXT = """
import math
import jax.numpy as jnp
import numpy as np
from rtac_jax import parameter
from rtac_jax.effects import Actuator, DryFriction, Force, Sensor


class Magnet({base}):
    {declared}
    {states}
    k: object = parameter({parameter})

    def {method}(self, {arguments}):
        x = motion.cart_position
        {body}
        return {returned}
"""
DECLARED = {
    "id": '"magnet"',
    "equation": '"-k q"',
    "source": '"own rig"',
    "port": '"cart"',
    "nature": '"conservative"',
}
PARAMETER = {"symbol": '"k"', "unit": '"N/m"', "meaning": '"stiffness"', "null": "0.0", "plausible": "1.0"}
WORDS = st.sampled_from(
    ["None", "1", "0.0", "-1e300", 'float("nan")', "math.inf", '"text"', '""', "()", "(1, 2, 3)", "[1.0]", "{}", "lambda s: s.mass",
     "lambda s: 1 / 0", "lambda: 1", "lambda s: None", '"a b"', '"cogging"', "object()", "lambda s: (s.force, -s.force)"]
)  # fmt: skip
LEAVES = [
    "x", "self.k", "motion.cart_velocity", "motion.sin", "own", "0.0", "1", "None", '"a"', "np.ones(3)", "jnp.ones(7)", "1j",
    "motion.nothing", "self.m", "[]", "jnp", "x > 0", "math.nan",
]  # fmt: skip
SIGNS = st.sampled_from(["+", "*", "/", "**", "@", "if x > 0 else", "and", ","])
FUNCTIONS = st.sampled_from(["math.sin", "np.sin", "jnp.sin", "float", "int", "len", "jnp.sum", "abs", "str", "-"])


def grown(inner):
    """Larger expressions around smaller ones."""
    joined = st.tuples(inner, SIGNS, inner).map(lambda parts: f"({' '.join(parts)})")
    return st.one_of(joined, st.tuples(FUNCTIONS, inner).map(lambda parts: f"{parts[0]}({parts[1]})"))


EXPRESSIONS = st.recursive(st.sampled_from(LEAVES), grown, max_leaves=4)
BODIES = st.sampled_from(
    ["pass", "x[0] = 1.0", "x = x.at[0].set(1.0)", "while x > 0: x = x - 1", "for one in x: pass", "raise KeyError(x)",
     'raise ValueError("two\\nlines")', "assert x > 0", "del motion", "import gremlins", "self.k = 1.0", "x.append(1)", "exit()"]
)  # fmt: skip


@st.composite
def texts(draw):
    declared, given = dict(DECLARED), dict(PARAMETER)
    for table in (declared, given):
        for name in draw(st.lists(st.sampled_from(sorted(table)), max_size=1)):
            if draw(st.booleans()):
                del table[name]
            else:
                table[name] = draw(WORDS)
    method, arguments = draw(
        st.sampled_from([("force", "motion, own")] * 4 + [("levels", "motion, own"), ("rate", "motion, own"), ("force", "motion"),
                         ("start", "motion"), ("read", "motion, own"), ("current", "motion, own"), ("plausible", "motion")])
    )  # fmt: skip
    return TEXT.format(
        base=draw(st.sampled_from(["Force"] * 4 + ["DryFriction", "Actuator", "Sensor", "object", "int"])),
        declared="; ".join(f"{name} = {text}" for name, text in declared.items()) or "pass",
        states=draw(st.sampled_from(["pass"] * 4 + ['states = {"z": "m"}', "states = 1", 'states = {"z": 1}', "states = []"])),
        parameter=", ".join(f"{name}={text}" for name, text in given.items()),
        method=method,
        arguments=arguments,
        body=draw(st.one_of(st.just("pass"), BODIES)),
        returned=draw(st.one_of(st.just("-self.k * x, 0.0"), EXPRESSIONS.map(lambda one: f"{one}, 0.0"), EXPRESSIONS)),
    )  # fmt: skip


@sizes(60, 500)
def test_effects_with_faults(trials, tmp_path):
    path = tmp_path / "mine.py"
    offered = []

    @fuzz(trials, text=texts())
    def trial(text):
        path.write_text(text)
        found = outcome(with_own, path)
        offered.append(found is not None)

    trial()
    assert any(offered)
    assert not all(offered)


@sizes(20, 150)
def test_files_that_are_no_effects(trials, tmp_path):
    path = tmp_path / "mine.py"

    @fuzz(
        trials,
        content=st.one_of(st.binary(max_size=40), st.text(st.characters(exclude_categories=("Cs",))).map(str.encode)),
    )
    def trial(content):
        path.write_bytes(content)
        assert outcome(with_own, path) is None

    trial()


@pytest.mark.parametrize("text", ["", "raise SystemExit(3)", "raise KeyboardInterrupt", "import os; os.abort"])
def test_a_file_that_ends_the_process_is_refused(tmp_path, text):
    (tmp_path / "mine.py").write_text(text)
    if "Keyboard" in text:
        with pytest.raises(KeyboardInterrupt):
            with_own(tmp_path / "mine.py")
    else:
        assert outcome(with_own, tmp_path / "mine.py") is None
