"""What an agreement says: it doubts what the rig has, and takes what both estimates hold for one."""

import numpy as np
import pytest

from estimators.inference import hausman
from estimators.inference.agreement import Agreement, Disagreement
from estimators.inference.simulation_residual import SimulationResidual


@pytest.mark.parametrize(
    ("channels", "words", "broken_by"),
    [
        (("cart_position", "arm_angle"), "the plane is level, and all channels", ("gravity_tilt", "channel_delay")),
        (("arm_angle", "arm_velocity"), "the plane is level, and all channels", ("tacho_bias", "tacho_lag")),
        (("arm_velocity",), "the integral of what the tachometer shows", ("tacho_bias", "tacho_lag")),
    ],
)
def test_no_sensor_is_doubted_that_the_rig_does_not_have(
    channels: tuple[str, ...], words: str, broken_by: tuple[str, ...]
) -> None:
    pair = Disagreement(("a", "b"), np.array([9.0]), np.zeros(1), np.ones(1), np.array([1e-12]), 1e-11)
    one, ask = np.ones((2, 1)), ("each moment", "the whole")
    found = Agreement(
        ("eccentric_moment",), ("kg m",), ("a", "b"), ask, one, one, (pair,), 0.01, 80, False, {}, None, channels
    )
    assert words in found.verdict
    assert found.suspects[:2] == broken_by
    assert ("tacho" in found.verdict) == ("arm_velocity" in channels)


@pytest.mark.parametrize(("left", "known", "confirms"), [(24.6, False, False), (3.0, False, True), (24.6, True, True)])
def test_far_beyond_a_noise_that_nobody_knows_agreement_confirms_nothing(
    left: float, known: bool, confirms: bool
) -> None:
    """Of a cart whose dry friction changes along its way, left at 25 times the noise: "what the estimates rest on holds"."""
    pair = Disagreement(("a", "b"), np.array([0.1]), np.zeros(1), np.ones(1), np.array([0.9]), 0.9)
    one, ask, nan = np.ones((2, 1)), ("each moment", "the whole"), float("nan")
    simulation = SimulationResidual("noise", "", left, nan, nan, 0.02, 0.0, "", known)
    found = Agreement(("mass",), ("kg",), ("a", "b"), ask, one, one, (pair,), 0.01, 80, False, {}, simulation)
    assert ("What the estimates rest on holds" in found.verdict) is confirms
    assert ("confirms nothing: the simulation is left at 24.6 times" in found.verdict) is not confirms


def test_what_both_took_from_one_measured_constant_is_no_disagreement() -> None:
    """Of the first quantity the two estimates differ by rounding: 2.3 deviations of it, and a joint p-value of 1e-9 before."""
    random = np.random.default_rng(0)
    own = random.normal(size=(80, 2, 2))
    own[:, 1, 0] = own[:, 0, 0] + 1e-13 * random.normal(size=80)
    both = np.ones(2, dtype=bool)
    found = hausman._pair(("a", "b"), np.array([1e-12, 0.5]), own, both)
    assert found is not None
    assert np.isnan(found.difference[0])
    assert np.isfinite(found.difference[1])
    assert found.p_value > 0.5
    assert hausman._pair(("a", "b"), np.array([1e-12, 0.5]), own, np.array([True, False])) is None


def test_an_estimator_that_says_nothing_of_a_parameter_disagrees_with_none() -> None:
    """A closed form without negative coefficients left friction of a direction that nothing shows at 0 +- 0: 19.8 deviations."""
    random = np.random.default_rng(0)
    drawn = random.normal(size=(80, 2, 2))
    drawn[:, 0, 0] = 0.0
    both = np.ones(2, dtype=bool)
    found = hausman._pair(("a", "b"), np.array([20.0, 0.5]), drawn, both)
    assert found is not None
    assert np.isnan(found.difference[0])
    assert found.p_value > 0.5
    assert hausman._pair(("a", "b"), np.array([20.0, 0.5]), drawn, np.array([True, False])) is None


def test_what_replicates_share_and_the_data_do_not_is_a_disagreement() -> None:
    """Where the model is right the two are one to a ten thousandth of their deviation; here they are fifty deviations apart."""
    random = np.random.default_rng(0)
    drawn = random.normal(size=(80, 2, 1))
    drawn[:, 1] = drawn[:, 0] + 1e-4 * random.normal(size=(80, 1))
    found = hausman._pair(("a", "b"), np.array([50.0]), drawn, np.array([True]))
    assert found is not None
    assert found.p_value < 1e-6
