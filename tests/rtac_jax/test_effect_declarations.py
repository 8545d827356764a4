"""What the declaration of an effect or of a parameter lacks, and an id that is not in the catalogue: refused in one sentence."""

from typing import Any, ClassVar

import pytest

from rtac_jax import Scales, effects, parameter
from rtac_jax.effects import CATALOGUE, Force

SCALES = Scales(
    position=5e-3, velocity=0.07, arm_velocity=10.0, current=0.1, force=0.8, torque=0.01, frequency=10.0, mass=1.2,
sample_time=0.002,
)  # fmt: skip


def test_unknown_effect_is_refused_with_the_list():
    with pytest.raises(ValueError, match="'nonsense' is not in the catalogue") as caught:
        effects.effect_class("nonsense")
    assert all(name in str(caught.value) for name in CATALOGUE)


@pytest.mark.parametrize(("symbol", "unit"), [("c", ""), ("", "N")])
def test_effect_without_unit_or_symbol_is_refused(symbol, unit):
    class Nameless(Force):
        """A parameter of it lacks its unit or its symbol."""

        id: ClassVar[str] = "nameless"
        equation: ClassVar[str] = "-c"
        source: ClassVar[str] = "none"
        port: ClassVar[str] = "cart"
        nature: ClassVar[str] = "source"
        constant: Any = parameter(symbol=symbol, unit=unit, meaning="a constant force", null=0.0)

        def force(self, motion, own):
            return -self.constant, 0.0

    with pytest.raises(ValueError, match="nameless: parameter constant needs a symbol and a unit"):
        Nameless(1.0)


def test_parameter_needs_an_interval():
    with pytest.raises(ValueError, match=r"parameter c: bounds .* are not an interval"):
        parameter(symbol="c", unit="N", meaning="a force", bounds=(1.0, -1.0))


def test_candidates_need_a_plausible_size():
    class Silent(Force):
        """A parameter of it has neither a null value nor a plausible size."""

        id: ClassVar[str] = "silent"
        equation: ClassVar[str] = "-c"
        source: ClassVar[str] = "none"
        port: ClassVar[str] = "cart"
        nature: ClassVar[str] = "source"
        constant: Any = parameter(symbol="c", unit="N", meaning="a constant force")

        def force(self, motion, own):
            return -self.constant, 0.0

    for build in (Silent.absent, lambda: Silent.candidates(SCALES)):
        with pytest.raises(ValueError, match="silent: parameter constant has no null value"):
            build()
