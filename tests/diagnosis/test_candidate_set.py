"""Effects of the user's own that cannot be looked for are refused in one sentence, before anything is computed."""

from typing import Any, ClassVar

import pytest

import rtac_jax as rtac
from estimators.diagnosis.candidate_set import offered, plausible, require_declared
from rtac_jax import parameter
from rtac_jax.effects import CATALOGUE, CubicSpring, Force
from rtac_jax.parameters import Scales

MODEL = rtac.RTAC.paper()


def size(**more: Any) -> Any:
    return parameter(symbol="k", unit="N/m^5", meaning="stiffness", **({"null": 0.0, "plausible": 1e9} | more))


def spring(name: str = "own_spring", declared: Any = None) -> type[Force]:
    class Spring(Force):
        id: ClassVar[str] = name
        equation: ClassVar[str] = "-k q^5"
        source: ClassVar[str] = "own rig"
        port: ClassVar[str] = "cart"
        nature: ClassVar[str] = "conservative"
        stiffness: Any = size() if declared is None else declared

        def force(self, motion: Any, own: Any) -> tuple[Any, Any]:
            return -self.stiffness * motion.cart_position**5, 0.0

    return Spring


class Nameless(Force):
    stiffness: Any = size()

    def force(self, motion: Any, own: Any) -> tuple[Any, Any]:
        return 0.0 * motion.cart_position, 0.0


def test_what_the_model_has_is_not_offered() -> None:
    own = spring()
    assert offered(MODEL, [own, CubicSpring]) == [own, CubicSpring]
    assert offered(MODEL + CubicSpring(1e4), [own, CubicSpring]) == [own]
    assert {c.id for c in offered(MODEL, None)} == set(CATALOGUE) - set(MODEL.ids) - {"second_cogging"}


def test_a_second_order_of_cogging_is_offered_beside_the_first_alone() -> None:
    first, second = CATALOGUE["cogging"], CATALOGUE["second_cogging"]
    assert offered(MODEL, [first, second]) == [first]
    assert offered(MODEL + first(1e-4, 0.0, 7.0), [first, second]) == [second]


@pytest.mark.parametrize(
    ("candidates", "said"),
    [
        ([Nameless], "Nameless has no id"),
        ([spring("own.spring")], "has the id 'own.spring'; use letters"),
        ([spring("cubic_spring"), CubicSpring], "cubic_spring occurs twice"),
        ([spring(declared=size(null=None))], "no parameter of own_spring has a null value"),
        ([spring(declared=size(null=1.0))], "own_spring.stiffness has the null value 1.0; write it as a deviation"),
        ([spring(declared=size(null=float("nan")))], "has the null value nan"),
    ],
)
def test_what_is_declared_wrongly_is_refused(candidates: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        offered(MODEL, candidates)


@pytest.mark.parametrize("wrong", ["cubic_spring", CubicSpring(1e4), rtac.RTAC])
def test_what_is_no_class_of_effects_is_refused(wrong: Any) -> None:
    with pytest.raises(ValueError, match="is no class of effects; give the class"):
        require_declared(wrong)


@pytest.mark.parametrize("wrong", [0.0, float("nan"), float("inf")])
def test_a_plausible_size_that_is_none_is_refused(wrong: float) -> None:
    scales = Scales(0.01, 0.1, 10.0, 0.3, 1.0, 0.01, 10.0, 1.0, 0.005)
    assert len(plausible(spring(), scales)) == 1
    with pytest.raises(ValueError, match=r"plausible size of own_spring\.stiffness"):
        plausible(spring(declared=size(plausible=wrong)), scales)
