"""A parameter that differs between experiments, hidden in the independent virtual rig."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.validation import differing_experiments
from estimators.validation.differing_experiments import differing
from rtac_jax import virtual_rig

RIG = virtual_rig.Rig().drawn(620)
STIFFNESS = RIG.spring_stiffness * (1 - 0.04 * np.arange(4))


@pytest.fixture(scope="module")
def softening() -> rtac.Recording:
    """Runs of a rig whose spring softens from one to the next; the decay by itself does not tell what the motor does."""
    plans = virtual_rig.standard_plans(seed=62, sample_time=0.01, duration=4.0, free=1, forced=3, rest=1)
    whole = virtual_rig.record(RIG, plans, seed=72)
    moving = [plan.name for plan in plans if plan.kind != "rest"]
    each = {
        name: virtual_rig.record(dataclasses.replace(RIG, spring_stiffness=float(k)), plans, seed=72)[name]
        for name, k in zip(moving, STIFFNESS, strict=True)
    }
    return dataclasses.replace(whole, experiments=tuple(each.get(e.name, e) for e in whole.experiments))


@pytest.fixture(scope="module")
def fit(softening: rtac.Recording) -> est.Fit:
    return est.output_error(rtac.RTAC.from_rig(softening), softening, progress=False)


@pytest.mark.slow
def test_the_parameter_with_which_all_are_followed_is_named_with_its_values(
    fit: est.Fit, softening: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where one of them, as a decay that does not show all parameters, could not be fitted by itself."""
    by_itself = est.constancy(fit, softening)
    lost = dataclasses.replace(by_itself, over_noise={"cart_position": 44.7}, varying=("eccentric_moment",))
    assert not lost.differences
    monkeypatch.setattr(differing_experiments, "constancy", lambda *_: lost)
    found = differing(fit, softening)
    assert found is not None
    assert found.varying == ("spring_stiffness",)
    assert found.is_of_the_rig
    assert max(found.over_noise.values()) < 1.3
    place = found.names.index("spring_stiffness")
    assert found.values[:, place] == pytest.approx(STIFFNESS, rel=1e-3)
    assert "drifts with the order of time" in found.differences


@pytest.mark.slow
def test_what_is_left_of_each_experiment_is_held_against_coloured_noise_where_that_is_larger(
    fit: est.Fit, softening: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fast changes show a part of it: an experiment followed to that noise is followed."""
    left = dataclasses.replace(est.constancy(fit, softening), over_noise={"cart_position": 1.65, "arm_velocity": 1.1})
    monkeypatch.setattr(differing_experiments, "constancy", lambda *_: left)
    monkeypatch.setattr(differing_experiments, "_with_own_parameter", lambda *given: given[2])
    monkeypatch.setattr(differing_experiments, "_suspects", lambda *_: [])
    assert differing(fit, softening) is None
    assert differing(fit, softening, coloured={"cart_position": 0.5 * fit.noise["cart_position"]}) is None
    found = differing(fit, softening, coloured={"cart_position": 1.5 * fit.noise["cart_position"]})
    assert found is not None
    assert found.varying == ("spring_stiffness",)
    assert found.over_noise == {"cart_position": pytest.approx(1.1), "arm_velocity": 1.1}


@pytest.mark.parametrize(
    ("left", "asked"),
    [
        ({"median_over_noise": {"cart_position": 1.0, "arm_velocity": 1.2}}, True),
        ({"median_over_noise": {"cart_position": 1.0, "arm_velocity": 1.4}}, False),
        ({"median_over_noise": {}}, True),
        ({"median_over_noise": {}, "chi_square": 0.4}, False),
    ],
)
@pytest.mark.slow
def test_a_parameter_of_each_experiment_is_tried_only_where_all_of_them_leave_room_for_it(
    fit: est.Fit, softening: rtac.Recording, monkeypatch: pytest.MonkeyPatch, left: dict[str, Any], asked: bool
) -> None:
    """By one step they explain more than half of the squares; fits of single experiments, where there are some, follow most."""
    samples = sum(fit.statistics["samples"].values())
    told = left | {"chi_square": left.get("chi_square", 0.6) * samples}
    by_itself = dataclasses.replace(est.constancy(fit, softening), over_noise={"cart_position": 44.7}, **told)
    tried = []
    monkeypatch.setattr(differing_experiments, "constancy", lambda *_: by_itself)
    monkeypatch.setattr(differing_experiments, "_suspects", lambda *_: [])
    monkeypatch.setattr(differing_experiments, "_with_own_parameter", lambda *given: tried.append(given) or given[2])
    assert differing(fit, softening) is None
    assert bool(tried) == asked


@pytest.mark.slow
def test_a_motor_that_warms_up_on_a_spring_that_softens_is_told_with_all_that_changes() -> None:
    """Friction falls in both directions, so that a set of three is what one fit has to confirm."""
    plans = virtual_rig.standard_plans(seed=62, sample_time=0.01, duration=4.0, free=2, forced=4, rest=1)
    whole = virtual_rig.record(RIG, plans, seed=72)
    moving = [plan.name for plan in plans if plan.kind != "rest"]
    passed = np.arange(len(moving))
    true = {
        "spring_stiffness": RIG.spring_stiffness * (1 - 0.02 * passed),
        "arm_viscous.positive": RIG.arm_viscous_positive * (1 - 0.08 * passed),
        "arm_viscous.negative": RIG.arm_viscous_negative * (1 - 0.08 * passed),
    }
    each = {}
    for place, name in enumerate(moving):
        now = {parameter.replace(".", "_"): float(values[place]) for parameter, values in true.items()}
        each[name] = virtual_rig.record(dataclasses.replace(RIG, **now), plans, seed=72)[name]
    recording = dataclasses.replace(whole, experiments=tuple(each.get(e.name, e) for e in whole.experiments))
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert fit.farthest > 3.0
    found = differing(fit, recording)
    assert found is not None
    assert set(found.varying) == set(true)
    assert found.confirmed
    assert found.is_of_the_rig
    for name, values in true.items():
        place = found.names.index(name)
        shown = np.isfinite(found.std[:, place])
        away = np.abs(found.values[:, place] - values)[shown] / found.std[shown, place]
        assert np.all(away < 4), "with the deviations that are stated"
        assert np.sum(found.std[shown, place] < 0.03 * values[shown]) >= 4, "a decay need not show both directions"
        assert f'"{name}"' in found.differences
    lost = dataclasses.replace(found, confirmed=False)
    assert not lost.differences


@pytest.mark.slow
def test_a_spring_that_hardens_is_no_parameter_that_differs() -> None:
    rig = dataclasses.replace(RIG, cubic_spring=6e5)
    plans = virtual_rig.standard_plans(seed=62, sample_time=0.01, duration=4.0, free=1, forced=3, rest=1)
    recording = virtual_rig.record(rig, plans, seed=72)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert fit.farthest > 3.0
    found = differing(fit, recording)
    assert found is None or not found.is_of_the_rig


@pytest.mark.slow
def test_where_no_experiment_was_fitted_by_itself_a_parameter_begins_at_the_common_fit(
    fit: est.Fit, softening: rtac.Recording
) -> None:
    found = est.constancy(fit, softening)
    place = found.names.index("spring_stiffness")
    alone = differing_experiments._begun(fit, dataclasses.replace(found, median_over_noise={}), [place])
    assert np.ptp(np.asarray(alone["spring_stiffness"])) == 0.0
    assert float(alone["torque_constant"]) == float(fit.model["torque_constant"])


@pytest.mark.parametrize(("fraction", "coloured", "asked"), [(0.08, 1.0, True), (0.15, 1.0, False), (0.15, 2.0, False)])
def test_fits_of_single_experiments_need_not_end_at_the_noise_where_the_common_one_is_far_from_it(
    fit: est.Fit,
    softening: rtac.Recording,
    monkeypatch: pytest.MonkeyPatch,
    fraction: float,
    coloured: float,
    asked: bool,
) -> None:
    """They begin at the common fit, and may not have come to their ends; what is named must follow all experiments to the noise."""
    left = {channel: fraction * ratio for channel, ratio in fit.residual_over_noise.items()}
    assert max(left.values()) / coloured > 1.3
    by_itself = dataclasses.replace(
        est.constancy(fit, softening), over_noise={"cart_position": 44.7}, median_over_noise=left,
        varying=("eccentric_moment",),
    )  # fmt: skip
    monkeypatch.setattr(differing_experiments, "constancy", lambda *_: by_itself)
    tried = []

    def refused(model: rtac.RTAC, *_: Any, **__: Any) -> est.Fit:
        tried.append(model)
        raise est.DivergedError("that is enough.")

    monkeypatch.setattr(differing_experiments, "_suspects", lambda *_: [])
    monkeypatch.setattr(differing_experiments, "output_error", refused)
    assert differing(fit, softening, coloured={c: coloured * size for c, size in fit.noise.items()}) is None
    own = [model for model in tried if "spring_stiffness" in model.per_experiment]
    assert bool(own) == asked
    for model in own:  # begun where each experiment by itself has it
        assert np.asarray(model["spring_stiffness"]) == pytest.approx(STIFFNESS, rel=0.02)
