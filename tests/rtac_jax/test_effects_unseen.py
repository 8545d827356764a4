"""What an effect says of what a recording did not reach of it."""

import pytest

from rtac_jax import effects


@pytest.mark.parametrize(
    ("extent", "said"),
    [
        ((-0.004, 0.006), "end_stop was touched at positive positions only: the other way the cart went no farther than 4 mm."),
        ((-0.006, 0.001), "end_stop was touched at negative positions only: the other way the cart went no farther than 1 mm."),
        ((0.002, 0.006), "end_stop was touched at positive positions only: the other way the cart went no farther than 0 mm."),
        ((-0.006, 0.006), ""),
        ((-0.0048, 0.006), ""),  # a sensor's offset may hide that it was
        ((-0.004, 0.004), ""),
    ],
)  # fmt: skip
def test_a_stop_that_was_touched_on_one_side_says_what_is_assumed(extent, said):
    stop = effects.EndStop(1e3, 0.005)
    assert stop.unseen({"cart_position": extent}).startswith(said)
    assert bool(stop.unseen({"cart_position": extent})) == bool(said)
    assert stop.unseen({}) == effects.CubicSpring(1.0).unseen({"cart_position": extent}) == ""


@pytest.mark.parametrize(
    ("yields", "said"), [(0.045, "yields over 45 mm, and the cart moved over 20 mm only"), (0.012, "")]
)
def test_a_hysteretic_spring_that_hardly_yields_says_what_is_not_told_apart(yields: float, said: str) -> None:
    spring = effects.HystereticSpring(400.0, yields)
    assert said in spring.unseen({"cart_position": (-0.011, 0.009)})
    assert bool(spring.unseen({"cart_position": (-0.011, 0.009)})) == bool(said)
    assert spring.unseen({}) == ""
