"""Laws that are in no catalogue: read off the missing force, and put in the place of effects that stand for a part of them.

The truth is an integrator of the test's own, with friction that is nearly discontinuous.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import made_up_results
import numpy as np
import pytest
from small_experiments import forced

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import read_law as module
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.policy import STANDARD
from estimators.misspecification.force_formulas import CurveEvidence
from rtac_jax.effects import CurrentLag, EndStop
from rtac_jax.measurement import Experiment, Recording

_MASS, _STIFFNESS, _VISCOUS, _COULOMB = 1.23, 132.6, 0.5543, 0.024
_MOMENT, _INERTIA, _MOTOR, _BEARING = 1.06e-3, 9.5e-5, 0.0804, 1.44e-4
_INTERVAL, _SAMPLES, _STEPS = 0.002, 2000, 10
_NOISE = (2e-5, 0.05)


def _slope(state: np.ndarray, current: np.ndarray, law: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    position, velocity, angle, speed = state
    force = -_STIFFNESS * position - _VISCOUS * velocity - _COULOMB * np.tanh(velocity / 1e-5) + law(position)
    force = force + _MOMENT * speed**2 * np.sin(angle)
    torque, coupling = _MOTOR * current - _BEARING * speed, _MOMENT * np.cos(angle)
    determinant = _MASS * _INERTIA - coupling**2
    return np.array(
        [
            velocity,
            (_INERTIA * force - coupling * torque) / determinant,
            speed,
            (_MASS * torque - coupling * force) / determinant,
        ]
    )


def recorded(law: Callable[[np.ndarray], np.ndarray], seed: int, free: int = 2, forced: int = 4) -> Recording:
    """Return decays and forced runs of a cart with a hidden force against its position, and a record at rest."""
    random, runs = np.random.default_rng(seed), free + forced
    frequency, phase = random.uniform(2.0, 60.0, (12, runs)), random.uniform(0.0, 2 * np.pi, (12, runs))
    size = np.where(np.arange(runs) < free, 0.0, random.uniform(0.12, 0.2, runs)) / np.sqrt(6)
    state = np.zeros((4, runs))
    state[0] = random.choice([-1.0, 1.0], runs) * np.where(
        size == 0.0, random.uniform(0.008, 0.015, runs), random.uniform(0.0, 0.005, runs)
    )
    state[2] = random.uniform(-3.0, 3.0, runs)
    step, states, currents = _INTERVAL / _STEPS, [], []
    for sample in range(_SAMPLES):
        current = size * np.sum(np.sin(frequency * sample * _INTERVAL + phase), axis=0)
        states.append(state)
        currents.append(current)
        for _ in range(_STEPS):
            a = _slope(state, current, law)
            b = _slope(state + 0.5 * step * a, current, law)
            c = _slope(state + 0.5 * step * b, current, law)
            d = _slope(state + step * c, current, law)
            state = state + step / 6 * (a + 2 * b + 2 * c + d)
    shown, played = np.array(states), np.array(currents)

    def experiment(run: int) -> Experiment:
        return Experiment.of(
            f"{'free' if run < free else 'forced'}_{run}",
            kind="free" if run < free else "forced",
            sample_time=_INTERVAL,
            current=played[:, run],
            cart_position=shown[:, 0, run] + _NOISE[0] * random.standard_normal(_SAMPLES),
            arm_velocity=shown[:, 3, run] + _NOISE[1] * random.standard_normal(_SAMPLES),
            initial_arm_angle=float(shown[0, 2, run]),
        )

    rest = Experiment.of(
        "rest_1",
        kind="rest",
        sample_time=_INTERVAL,
        current=np.zeros(_SAMPLES // 2),
        cart_position=_NOISE[0] * random.standard_normal(_SAMPLES // 2),
        arm_velocity=_NOISE[1] * random.standard_normal(_SAMPLES // 2),
    )
    constants = {"total_mass": _MASS, "arm_inertia": _INERTIA}
    return Recording((*(experiment(run) for run in range(runs)), rest), rig=constants)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "seed", "name", "truth"),
    [
        (lambda q: -2e9 * q**5, 6, "law_of_cart_position_power5", {"coefficient_1": -2e9}),
        (
            lambda q: -0.12 * np.sin(500.0 * q),
            7,
            "law_of_cart_position_sine",
            {"coefficient_1": -0.12, "shape_1": 500.0},
        ),
    ],
    ids=["a fifth power that an end stop resembles", "a detent with teeth"],
)
def test_a_law_that_is_in_no_catalogue_takes_the_place_of_what_resembles_it(
    law: Callable[[np.ndarray], np.ndarray], seed: int, name: str, truth: dict[str, float]
) -> None:
    recording = recorded(law, seed)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert [candidate.id for candidate in found.added] == [name], found.headline
    assert found.verdict == "missing"
    assert found.learned is None
    for parameter, value in truth.items():
        fitted = found.final.parameters[f"{name}.{parameter}"]
        assert abs(fitted.value - value) < max(5 * fitted.std, 2e-3 * abs(value)), (parameter, fitted)
    after = found.validation.models[-1].errors
    assert max(error.rms_over_noise for error in after.values()) < 1.1
    assert f"{name} (a law read off the data) was missing" in found.headline
    assert "is a law read off the missing force, in no catalogue" in found.ending


@pytest.mark.slow
def test_a_spring_that_hardens_as_a_hyperbolic_sine_is_a_cubic_one_and_the_power_that_follows() -> None:
    recording = recorded(lambda q: -0.2 * np.sinh(q / 0.004) + 0.2 * q / 0.004, seed=8)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert [candidate.id for candidate in found.added] == ["cubic_spring", "law_of_cart_position_power5"], (
        found.headline
    )
    assert found.mended == "adequate"
    assert "power5" in found.headline
    assert "in no catalogue, and is added: the held-out experiments were left at" in found.ending
    assert max(error.rms_over_noise for error in found.validation.models[-1].errors.values()) < 1.1
    # The series of the sine at the ends of the motion, 11 mm: the terms that are left out go to these two.
    named = found.final.parameters
    assert named["cubic_spring.stiffness"].value == pytest.approx(0.2 / 6 / 0.004**3, rel=0.2)
    assert named["law_of_cart_position_power5.coefficient_1"].value == pytest.approx(-0.2 / 120 / 0.004**5, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "seed", "name"),
    [
        (lambda q: -4e8 * q**5, 6, "law_of_cart_position_power5"),
        (lambda q: -400.0 * np.sign(q) * np.maximum(np.abs(q) - 0.009, 0.0), 7, "end_stop"),
        (lambda q: -15.0 * np.sign(q) * np.maximum(np.abs(q) - 0.007, 0.0), 8, "end_stop"),
    ],
    ids=["a weak fifth power", "an end stop", "a weak end stop"],
)
def test_a_law_of_fewer_parameters_takes_the_place_of_an_end_stop_where_it_is_likelier(
    law: Callable[[np.ndarray], np.ndarray], seed: int, name: str
) -> None:
    recording = recorded(law, seed)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert [candidate.id for candidate in found.added] == [name], found.headline
    assert found.mended == "adequate"
    assert max(error.rms_over_noise for error in found.validation.models[-1].errors.values()) < 1.1
    if name != "end_stop":
        fitted = found.final.parameters[f"{name}.coefficient_1"]
        assert abs(fitted.value + 4e8) < 3 * fitted.std < 1e8
        assert "takes the place of end_stop" in found.ending


@pytest.mark.parametrize(
    ("gain", "error", "taken"),
    [(60.0, 1.0, True), (8.0, 1.0, False), (60.0, 3.0, False)],
    ids=["likelier", "hardly likelier", "worse where it was held out"],
)
def test_a_simpler_law_must_be_far_likelier_and_no_worse_where_nothing_was_fitted(
    monkeypatch: pytest.MonkeyPatch, gain: float, error: float, taken: bool
) -> None:
    """Of the laws that the curve proposes one has a single parameter, and an end stop has two."""
    model = rtac.RTAC.paper() + EndStop(1e3, 0.01) + CurrentLag(2e-3)
    fit = dataclasses.replace(made_up_results.FIT, model=model)
    last = Added(fit, made_up_results.compared("both", 1.0), "simulated")
    added = [made_up_results.candidate(name, 50.0) for name in ("end_stop", "current_lag")]
    at = np.linspace(-0.012, 0.012, 12)
    evidence = CurveEvidence(np.stack([1e4 * np.eye(12)] * 4), np.stack([1e4 * -2e9 * at**5] * 4))
    curve = dataclasses.replace(made_up_results.curve("cart", "cart_position", 0.012), at=at, evidence=evidence)
    named = dataclasses.replace(made_up_results.diagnosis("missing", curves=(curve,)), effects=tuple(added[:1]))
    monkeypatch.setattr(module, "_bic", lambda one: 0.0 if one is fit else -gain)
    asked: list[tuple[tuple[str, ...], str]] = []

    def fitted(_: Added, given_up: list[str], several: list[Any], label: str, *__: object, **___: object) -> Added:
        asked.append((tuple(given_up), label))
        return Added(dataclasses.replace(fit), made_up_results.compared(label, error), "simulated")

    monkeypatch.setattr(module, "extended_without", fitted)
    monkeypatch.setattr(module, "is_sure", lambda *_: True)
    monkeypatch.setattr(module, "_text", lambda *_: "the law")
    nothing = Recording((forced(),), rig={})
    found = module.simpler_law(last, added, [named], nothing, nothing, policy=STANDARD, progress=False)
    assert asked == [(("end_stop",), "+ current_lag, law_of_cart_position_power5")]
    assert (found is not None) == taken
    if found is not None:
        assert found.among(added) == [added[1], found.law]
    # Nothing is asked of an effect that no diagnosis named, or beside which no static force rejects.
    asked.clear()
    for quiet in (dataclasses.replace(named, effects=()), dataclasses.replace(named, tests=())):
        assert module.simpler_law(last, added, [quiet], nothing, nothing, policy=STANDARD, progress=False) is None
    assert asked == []


@pytest.mark.parametrize(
    ("errors", "sure", "place", "given_up"),
    [
        ((2.0, 0.5, 3.0), True, 1, ("end_stop",)),
        ((2.0, 1.5, 3.0, 3.0, 3.0, 0.5), True, 5, ()),
        ((2.0, 1.5, 3.0, 3.0, 3.0, 0.5), False, 1, ("end_stop",)),
        ((2.0, 1.5, 3.0, 3.0, 3.0, 2.0), True, 1, ("end_stop",)),
    ],
    ids=["followed in that place", "followed beside it", "beside it nothing is left of the force", "not followed"],
)
def test_a_law_takes_the_place_of_forces_on_the_same_part_and_of_nothing_else(
    monkeypatch: pytest.MonkeyPatch, errors: tuple[float, ...], sure: bool, place: int, given_up: tuple[str, ...]
) -> None:
    """Of three laws the one that leaves least; none where no law leaves clearly less than before.

    Beside these forces laws are tried where in their place none follows to the noise.
    """
    model = rtac.RTAC.paper() + EndStop(1e3, 0.01) + CurrentLag(2e-3)
    before = Added(
        dataclasses.replace(made_up_results.FIT, model=model), made_up_results.compared("both", 4.0), "simulated"
    )
    added = [made_up_results.candidate(name, 50.0) for name in ("end_stop", "current_lag")]
    at = np.linspace(-0.012, 0.012, 12)
    evidence = CurveEvidence(np.stack([1e4 * np.eye(12)] * 4), np.stack([1e4 * -2e9 * at**5] * 4))
    curve = dataclasses.replace(made_up_results.curve("cart", "cart_position", 0.012), at=at, evidence=evidence)
    left = iter(errors)
    asked: list[tuple[tuple[str, ...], str]] = []

    def fitted(
        last: Added, given_up: tuple[str, ...], several: list[Any], label: str, *_: object, **__: object
    ) -> Added:
        assert len(several) == 1
        asked.append((given_up, label))
        return dataclasses.replace(last, tested=made_up_results.compared(label, next(left, 4.0)))

    monkeypatch.setattr(module, "extended_without", fitted)
    monkeypatch.setattr(module, "is_sure", lambda _, effect: sure or effect != "end_stop")
    monkeypatch.setattr(module, "_text", lambda *_: "the law")
    nothing = Recording((forced(),), rig={})
    found = module.read_law(before, added, curve, nothing, nothing, policy=STANDARD, progress=False)
    assert found is not None
    assert [several for several, _ in asked] == [("end_stop",)] * 3 + [()] * (len(errors) - 3)
    assert all(label.startswith("+ current_lag, law_of_cart_position_") for _, label in asked[:3])
    assert all(label.startswith("+ end_stop, current_lag, law_of_cart_position_") for _, label in asked[3:])
    assert found.step.tested.label == asked[place][1]
    assert found.given_up == given_up
    assert found.law.parameters
    assert found.among(added) == [*(added[1:] if given_up else added), found.law]
    said = "takes the place of end_stop" if given_up else "is added"
    assert f"in no catalogue, and {said}: the held-out experiments were left at" in found.said(
        before.tested, found.step
    )
    assert module.read_law(before, added, curve, nothing, nothing, policy=STANDARD, progress=False) is None
    bare = dataclasses.replace(curve, evidence=None)
    assert module.read_law(before, added, bare, nothing, nothing, policy=STANDARD, progress=False) is None
