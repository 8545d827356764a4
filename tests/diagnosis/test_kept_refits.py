"""The filter's pass of a refit is dropped when others were used since, and comes back to the same bits."""

import jax.numpy as jnp
import numpy as np
import pytest
from small_experiments import forced, free, rest

from estimators.diagnosis.kept_refits import KeptRefits
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import fit_base
from estimators.diagnosis.setting import Setting, set_up
from estimators.misspecification.candidate_screening import Screened, without_templates
from rtac_jax import RTAC
from rtac_jax.effects import CubicSpring
from rtac_jax.measurement import Recording


class Silent:
    """A bar that shows nothing."""

    def update(self, steps: int) -> None: ...

    def set_postfix_str(self, text: str, refresh: bool) -> None: ...


@pytest.fixture(scope="module")
def fitted() -> tuple[Setting, Refit]:
    recording = Recording((free(), forced(), rest()), {"total_mass": 1.23, "arm_inertia": 9.5e-5})
    setting = set_up(RTAC.from_rig(recording), recording, [CubicSpring], {}, 1, Silent())
    return setting, fit_base(setting)


def test_a_pass_comes_back_to_the_same_bits(fitted: tuple[Setting, Refit]) -> None:
    refits = KeptRefits(passes=2)
    for _ in range(4):
        refits.add(*fitted)
    pass_before = fitted[1].predictor.filtered
    held = [refits.light(number).predictor.filtered for number in range(4)]
    assert [len(one.gain) > 0 for one in held] == [False, False, True, True]
    for one in held:  # what compares models stays
        np.testing.assert_array_equal(one.log_likelihood, pass_before.log_likelihood)
    setting, again = refits.whole(0)
    assert setting is fitted[0]
    for name, value in again.predictor.filtered._asdict().items():
        np.testing.assert_array_equal(value, getattr(pass_before, name), err_msg=name)
    assert [len(refits.light(n).predictor.filtered.gain) > 0 for n in range(4)] == [True, False, False, True]


def test_the_refit_that_was_used_last_keeps_its_pass(fitted: tuple[Setting, Refit]) -> None:
    refits = KeptRefits(passes=2)
    refits.add(*fitted)
    refits.add(*fitted)
    assert refits.whole(0)[1] is fitted[1]
    refits.add(*fitted)
    assert [len(refits.light(n).predictor.filtered.gain) > 0 for n in range(3)] == [True, False, True]


def test_a_score_without_what_it_was_computed_from_is_the_same_score() -> None:
    one = Screened(
        "cubic_spring",
        CubicSpring(1e4),
        ("stiffness",),
        np.array([5e4]),
        30.0,
        1e-8,
        np.array([1e3]),
        np.ones((100, 1)),
    )
    light = without_templates(one)
    assert light.templates.shape == (0, 1)
    assert (light.id, light.statistic, light.p_value) == (one.id, one.statistic, one.p_value)
    assert jnp.array_equal(light.begin, one.begin)
