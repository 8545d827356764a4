"""The rule that names effects, on made-up gains: nearly everything that was wrong before an effect must go with it."""

import dataclasses
import math

import made_up_results
import numpy as np
import pytest
from small_experiments import free, rest

from estimators.core.fit import Parameter
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.explanation import out_of_time, shaken, strayed, words
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.removed_error import fraction_removed, named
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import AdequacyTest
from estimators.misspecification.line_classes import LineClass
from estimators.misspecification.residual_maps import Place
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.latent_force import LatentForce
from rtac_jax.measurement import Recording

SAMPLES = 10_000


def found(excess: float) -> AdequacyTest:
    return AdequacyTest("static force", 0.0 if excess > 0 else 0.5, excess, 0.002, "")


def step(name: str, gain: float, left: float, rivals: tuple[str, ...] = ()) -> Step:
    blank = FittedModel(1, (name,), 1, 0.0)  # the rule asks nothing of the fit itself
    return Step(name, rivals, gain, gain, gain, blank, (found(left),))


def test_an_adequate_model_whose_simulation_strays_says_so() -> None:
    noise = {"cart_position": 1e-5, "arm_velocity": 0.05}
    moving, still = free("free_1"), rest("rest_1")
    assert strayed({"cart_position": 2e-5, "arm_velocity": 0.1}, noise, Recording((moving, still))) == ""
    far = {"cart_position": 3.2e-4, "arm_velocity": 1.0}
    assert "32 times the noise away from the recording (cart_position)" in strayed(
        far, noise, Recording((moving, still))
    )
    assert "32 times the noise that its fast changes show away" in strayed(far, noise, Recording((moving,)))
    near = {"cart_position": 9e-5, "arm_velocity": 0.1}
    assert "9 times the noise away" in strayed(near, noise, Recording((moving, still)))
    assert strayed(near, noise, Recording((moving,))) == ""  # nobody knows that noise
    assert "43 % of the motion away from the recording" in strayed(far, noise, Recording((moving,)), unfollowed=0.43)


@pytest.mark.parametrize(
    ("steps", "verdict", "count"),
    [
        ([], "unknown", 0),
        ([step("a", 500.0, 0.0)], "missing", 1),
        ([step("a", 500.0, 40.0)], "missing", 1),  # 93 %
        ([step("a", 500.0, 100.0)], "unknown", 0),  # 83 %: the best of a bad set
        ([step("a", 500.0, 0.0, ("b",))], "ambiguous", 1),
        # Two of a size: neither alone, but both together.
        ([step("a", 500.0, 400.0), step("b", 400.0, 0.0)], "missing", 2),
        # Each of them the other's rival, and both named: they act beside each other.
        ([step("a", 500.0, 400.0, ("b",)), step("b", 400.0, 0.0)], "missing", 2),
        # A strong effect does not carry a doubtful one along.
        ([step("a", 5000.0, 100.0), step("b", 50.0, 60.0)], "missing", 1),
        ([step("a", 5000.0, 100.0, ("b",)), step("b", 50.0, 60.0)], "ambiguous", 1),
        ([step("a", 300.0, 300.0), step("b", 100.0, 200.0), step("c", 50.0, 150.0)], "unknown", 0),
    ],
)
def test_what_is_named(steps: list[Step], verdict: str, count: int) -> None:
    assert named(steps, (found(600.0),), SAMPLES, STANDARD)[:2] == (verdict, count)


def test_what_was_fitted_alone_is_not_said_to_be_unfitted_when_the_time_is_over() -> None:
    both = out_of_time(("saturation", "backlash"), {"saturation", "cubic_spring"})
    assert "was over before backlash was fitted, and saturation was fitted beside what else is missing:" in both
    assert "was over before a, b were fitted:" in out_of_time(("a", "b"))
    many = out_of_time([f"e{n}" for n in range(9)])
    assert "e0, e1, e2, e3, e4, e5 and 3 more were fitted" in many


def test_nothing_found_and_nothing_wrong_is_adequate() -> None:
    assert named([], (found(0.0),), SAMPLES, STANDARD) == ("adequate", 0, 0.0)


def test_the_share_is_that_of_the_excess_squared_error() -> None:
    # The error falls to a quarter, of which a tenth could still be explained: from 1 to 0.25 where 0.225 is possible.
    one = step("a", SAMPLES * math.log(4), 0.1 * SAMPLES)
    assert fraction_removed([one], SAMPLES) == pytest.approx(0.75 / 0.775)


def missing_force(**rms: float) -> LatentForce:
    shape = (4, len(rms))
    return LatentForce("cart", tuple(rms), np.ones(shape), np.ones(shape), (0.02, 0.001), rms, 10.4, 900.0)


@pytest.mark.parametrize(
    ("rms", "shown"),
    [
        ({"free_1": 0.007, "forced_1": 0.035, "forced_2": 0.02}, "at 10.4 rad/s and in forced_1, forced_2"),
        ({"free_1": 0.03, "forced_1": 0.035}, "in all experiments alike, most in forced_1"),
        ({"free_1": 0.03}, "at 10.4 rad/s and in free_1"),
    ],
)
def test_unknown_says_which_experiments_carry_the_force(rms: dict[str, float], shown: str) -> None:
    assert shown in unknown([missing_force(**rms)], [])


def test_unknown_says_which_lines_of_a_periodic_input_show_it() -> None:
    quiet, telling = (LineClass("even", "arm_velocity", 1.1, 0.3), LineClass("odd", "cart_position", 3.2, 1e-6))
    text = unknown([], [quiet, telling])
    assert "On the odd lines of the periodic input cart_position has 3.2 times the power of the noise" in text
    assert "an odd nonlinearity" in text
    assert "periodic input" not in unknown(
        [], [quiet, LineClass("odd", "cart_position", 1.5, 0.006)]
    )  # one of two by chance


def test_where_it_shows_is_said_only_beyond_chance() -> None:
    within, beyond = (Place("experiment", "free_1", "arm_velocity", value, 1.1) for value in (1.08, 1.2))
    said = [words("unknown", [], [], [], (found(600.0),), (), 0.0, [], [], [place], []) for place in (within, beyond)]
    assert "no channel of any experiment is farther off than chance allows" in said[0]
    assert "shows most in" not in said[0]
    assert "It shows most in arm_velocity of free_1 (1.20 times the expected squares)" in said[1]


@pytest.mark.parametrize(
    ("excess", "said"),
    [
        (500.0, "It depends most on cart_position (cart)."),
        (
            200.0,
            "a static function of position, velocity, angle or current explains less than half; a simulation may tell",
        ),
    ],
)
def test_a_static_force_is_judged_by_its_test(excess: float, said: str) -> None:
    """Not by the price of its points, which a force in a narrow range seldom pays."""
    at = np.linspace(-1.0, 1.0, 12)
    curve = ForceCurve("cart", "cart_position", -5.0, at, at, at, 90.0, excess, 1e-15, np.eye(12)[:3], np.ones(3))
    other = dataclasses.replace(curve, variable="current", score=-2.0, excess=10.0)
    tests = (found(600.0), AdequacyTest("delayed force", 0.0, 600.0, 0.002, ""))
    assert said in words("unknown", [], [], [], tests, (), 0.0, [other, curve], [], [], [])
    passing = (dataclasses.replace(tests[0], p_value=0.5), tests[1])
    assert "What is missing is no static function" in words(
        "unknown", [], [], [], passing, (), 0.0, [curve], [], [], []
    )


def unknown(latent: list[LatentForce], lines: list[LineClass]) -> str:
    return words("unknown", [], [], [], (found(600.0),), (), 0.0, [], latent, [], lines)


def test_a_parameter_that_is_fixed_is_told_without_a_deviation() -> None:
    one = Candidate.__new__(Candidate)
    parameters = {"compliance": Parameter(3e-4, 1e-6, "s^2"), "fastest": Parameter(450.0, 0.0, "rad/s")}
    for name, part in {"id": "a", "parameters": parameters}.items():
        object.__setattr__(one, name, part)
    text = words("missing", [one], [one], [step("a", 500.0, 0.0)], (found(600.0),), (), 1.0, [], [], [], [])
    assert "a (compliance = 0.0003 +- 1e-06 s^2, fastest = 450 rad/s, fixed) gains" in text


@pytest.mark.parametrize(
    ("late", "said", "decided"),
    [
        ((), "the data cannot tell a or b, c apart.", True),
        (
            ("c",),
            "the data cannot tell a or b apart, and the time was over before all were held against each other, c against a.",
            True,
        ),
        (("b", "c"), "Ambiguous: the time was over before all were held against each other, b, c against a.", False),
    ],
)
def test_what_was_not_held_against_the_best_in_time_is_not_said_to_be_like_it(
    late: tuple[str, ...], said: str, decided: bool
) -> None:
    one = Candidate("a", 500.0, 509.0, 0.0, 0.01, "N", True, refitted=True)
    text = words(
        "ambiguous", [one], [one], [dataclasses.replace(step("a", 500.0, 0.0, ("b", "c")), late=late)], (found(600.0),), (), 1.0,
        [], [], [], [],
    )  # fmt: skip
    assert said in text
    assert ("An experiment that separates them" in text) == decided


def test_random_forces_are_told_of_where_they_matter():
    assert shaken(1e-4, 2e-3, 0.01) == ""
    assert "(5.8 % of the rms force in one sample)" in shaken(0.058, 3e-3, 0.0)  # of an arm that is locked, say
    assert "(5.8 % of the rms force and 2 % of the rms torque in one sample)" in shaken(0.058, 0.02, 0.0)
    assert "est.prediction_error_nonlinear" in shaken(1e-5, 0.02, 0.0)
    assert shaken(1e-5, 1e-5, 0.12).startswith(" 12 % of the samples do not count")


def test_of_a_pair_the_one_that_gains_nothing_alone_is_said_to_be_part_of_it() -> None:
    """As drag whose curvature dry friction hides, of which simulations name both."""
    alone, both = (
        FittedModel(1, ("arm_quadratic_drag",), 1, 0.0),
        FittedModel(2, ("arm_quadratic_drag", "arm_coulomb"), 2, 0.0),
    )
    steps = [
        Step("arm_quadratic_drag", (), 7.0, -2.0, -12.0, alone, ()),
        Step("arm_coulomb", (), 700.0, 692.0, 349.0, both, ()),
    ]
    several = tuple(made_up_results.candidate(step.id, 9.0) for step in steps)
    said = words("missing", several, several, steps, (), (), 1.0, (), (), (), ())
    assert "which explains nothing without what comes next; arm_coulomb (" in said
    assert "gains 692 in BIC" in said
    assert "-2" not in said
    last = [dataclasses.replace(steps[1], bic_gain=-7.0, held_out_gain=0.0)]
    said = words("missing", several[1:], several[1:], last, (), (), 1.0, (), (), (), ())
    assert ") makes predictions one sample ahead no likelier, and simulations better." in said
    assert "-7" not in said
