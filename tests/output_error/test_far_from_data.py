"""Fits that stay far from the data: led by predictions after a few steps of simulation, and not a second time."""

import dataclasses

import numpy as np
import pytest
from exact_decay import MASS, STIFFNESS, VISCOUS, exact_decay

import estimators as est
import rtac_jax as rtac
from estimators.output_error.descent import _UNLED_STEPS, Descent


@pytest.fixture(scope="module")
def recording():
    noise = 5e-5 * np.random.default_rng(4).standard_normal(150)
    position = exact_decay(0.012, 0.02 * np.arange(150)) + noise
    one = rtac.Experiment.of(
        "free_1", kind="free", sample_time=0.02, arm="locked", initial_arm_angle=0.0, cart_position=position,
        noise_std={"cart_position": 5e-5},
    )  # fmt: skip
    return rtac.Recording([one], rig={"total_mass": MASS})


@pytest.fixture(scope="module")
def model(recording):
    """Ten times the noise off, and a twentieth of the motion."""
    begin = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    return begin.with_values({"spring_stiffness": 0.993 * STIFFNESS, "cart_viscous.coefficient": VISCOUS})


def unfinished(end, times):
    """Return the end as it would be had the steps run out, so many times as far from the data."""
    solved = end.solved._replace(converged=False, promised=1e3)
    return dataclasses.replace(end, solved=solved, deviation=times * end.deviation)


@pytest.mark.parametrize(("times", "descents"), [(1.0, 2), (100.0, 1)])
def test_one_that_did_not_end_goes_on_only_near_the_data(monkeypatch, recording, model, times, descents):
    begun, known = [], Descent.descend

    def descended(self, begin, **options):
        begun.append(begin)
        return unfinished(known(self, begin, **options), times)

    monkeypatch.setattr(Descent, "descend", descended)
    est.output_error(model, recording, from_model=True, progress=False)
    assert len(begun) == descents


@pytest.mark.parametrize(("times", "led", "most"), [(1.0, 0, [_UNLED_STEPS, None]), (100.0, 1, [_UNLED_STEPS, None])])
def test_given_values_far_from_the_data_are_led_after_a_few_steps(monkeypatch, recording, model, times, led, most):
    asked, guided, weighted, guide = [], [], Descent._weighted, Descent._guided

    def watched(self, *given, most=None):
        asked.append(most)
        end = weighted(self, *given, most=most)
        return end if most is None else unfinished(end, times)

    def counted(self, *given):
        guided.append(1)
        return guide(self, *given)

    monkeypatch.setattr(Descent, "_weighted", watched)
    monkeypatch.setattr(Descent, "_guided", counted)
    fit = est.output_error(model, recording, from_model=True, progress=False)
    assert asked == most
    assert len(guided) == led
    assert fit.parameters["spring_stiffness"].value == pytest.approx(STIFFNESS, rel=2e-3)
