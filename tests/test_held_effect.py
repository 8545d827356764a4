"""An effect that a simulation cannot fit is held at the estimate of the diagnosis, and kept if the held-out error falls."""

import dataclasses
import zlib
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators import _improve
from estimators._compare import Compared
from estimators._covariance import information_of
from estimators._improve import holding
from estimators._output_error import Parameter
from estimators._report import _with_held
from estimators._results import RESULTS
from rtac_jax import virtual_rig
from rtac_jax.effects import ArmStribeck, CubicSpring
from rtac_jax.measurement import Experiment

FREE, HELD = "free", "held"
BEFORE = 4.0  # held-out error of the base model
Kind = TypeVar("Kind")


def made(cls: type[Kind], **parts: Any) -> Kind:
    """An object of which these parts are known only."""
    found = cls.__new__(cls)
    for name, part in parts.items():
        object.__setattr__(found, name, part)
    return found


def fit_of(model: rtac.RTAC, names: tuple[str, ...], **statistics: Any) -> est.Fit:
    """A fit of which deviations of one are known for these parameters."""
    known = information_of(np.eye(len(names)), names, np.ones(len(names)))
    return est.Fit(model, RESULTS.successful, known, {}, {}, {}, (), statistics)


class Known(Compared):
    """A comparison of which the errors are known beforehand."""

    known: Any

    @property
    def errors(self) -> Any:
        return self.known


def test_nothing_of_an_effect_that_is_held_is_fitted() -> None:
    base = rtac.RTAC.paper()
    stribeck = ArmStribeck(level=4e-4, velocity=0.8)
    model = holding(base + stribeck + CubicSpring(stiffness=5e4), ["arm_stribeck", "cubic_spring"])
    assert model.free == base.free
    assert float(model["arm_stribeck.level"]) == 4e-4
    assert float(model["cubic_spring.stiffness"]) == 5e4
    assert set((base + stribeck).free) - set(base.free) == {"arm_stribeck.level", "arm_stribeck.velocity"}


@pytest.mark.parametrize(
    ("errors", "kept", "held", "said"),
    [
        ({FREE: 1.0, HELD: 2.0}, True, False, "nothing more"),
        ({FREE: 5.0, HELD: 2.0}, True, True, "Held at the estimate of the diagnosis"),
        ({FREE: None, HELD: 2.0}, True, True, "cubic_spring. Stopped"),
        ({FREE: 5.0, HELD: 6.0}, False, False, "would not fall"),
        ({FREE: 5.0, HELD: 3.9}, False, False, "would not help clearly either"),
        ({FREE: 3.9, HELD: 2.0}, True, False, "nothing more"),
        ({FREE: None, HELD: 6.0}, False, False, "could not be fitted: leaves it free"),
        ({FREE: None, HELD: None}, False, False, "could not be fitted: leaves it free"),
    ],
)
def test_what_is_kept(
    monkeypatch: pytest.MonkeyPatch, errors: dict[str, float | None], kept: bool, held: bool, said: str
) -> None:
    spring = CubicSpring(stiffness=5e4)
    candidate = est.Candidate(
        id="cubic_spring", score=100.0, p_value=1e-9, detection_limit=1.0, unit="N/m^3", testable=True, correlation={}
    )

    def fitted(model: rtac.RTAC, *_: Any, **__: Any) -> est.Fit:
        kind = "base" if "cubic_spring" not in model else FREE if "cubic_spring.stiffness" in model.free else HELD
        error = BEFORE if kind == "base" else errors[kind]
        if error is None:
            raise est.NotIdentifiableError("leaves it free")
        return fit_of(model, ("total_mass",), error=error)

    def compared(fits: Any, *_: Any, labels: list[str]) -> est.Comparison:
        several = fits if isinstance(fits, list) else [fits]
        error = [{"cart_position": SimpleNamespace(rms_over_noise=f.statistics["error"])} for f in several]
        return est.Comparison(tuple(made(Known, label=x, known=e) for x, e in zip(labels, error, strict=True)))

    def diagnosed(fit: est.Fit, *_: Any, **__: Any) -> est.Diagnosis:
        if "cubic_spring" in fit.model:
            assert "cubic_spring.stiffness" in fit.model.free  # also where a simulation held it
            return made(est.Diagnosis, verdict="adequate", effects=(), additions=())
        return made(est.Diagnosis, verdict="missing", effects=(candidate,), additions=(spring,))

    for name, stub in {"output_error": fitted, "compare": compared, "diagnose": diagnosed}.items():
        monkeypatch.setattr(_improve, name, stub)
    monkeypatch.setattr(_improve, "compile_diagnosis", lambda *_: None)
    two = [
        Experiment.of(f"free_{n}", kind="free", sample_time=0.01, cart_position=np.cos(np.arange(99))) for n in (1, 2)
    ]
    found = _improve.improve(rtac.RTAC.paper(), rtac.Recording(two), progress=False)
    assert [c.id for c in found.added] == (["cubic_spring"] if kept else [])
    assert found.held == (("cubic_spring",) if held else ())
    assert found.verdict == ("missing" if kept else "unknown")
    assert said in found.ending


def test_a_report_gives_the_deviation_of_the_diagnosis_for_what_is_held() -> None:
    told = {"stiffness": Parameter(5e4, 300.0, "N/m^3")}
    candidate = est.Candidate(
        id="cubic_spring", score=100.0, p_value=1e-9, detection_limit=1.0, unit="N/m^3", testable=True, parameters=told
    )
    model = rtac.RTAC.paper() + CubicSpring(stiffness=6e4)
    free, held = fit_of(model, ("total_mass", "cubic_spring.stiffness")), fit_of(model, ("total_mass",))
    found = [_with_held(fit, [candidate])["cubic_spring.stiffness"] for fit in (free, held)]
    assert [(p.value, p.std) for p in found] == [(6e4, 1.0), (5e4, 300.0)]


@pytest.mark.slow
def test_on_a_shaken_rig_the_loop_goes_on() -> None:
    """The first rig on which a simulation left free what the diagnosis had told."""
    seed = 10 * zlib.crc32(b"13 arm_stribeck")
    hidden = {"arm_stribeck": 4e-4, "arm_stribeck_velocity": 1.0, "force_noise": 1e-3, "torque_noise": 3e-5}
    rig = dataclasses.replace(virtual_rig.Rig().drawn(seed), **hidden)
    ahead = {"sample_time": 0.002, "duration": 5.0}
    plans = virtual_rig.standard_plans(seed=seed + 1, free=2, forced=4, rest=1, repeats=1, **ahead)
    checks = virtual_rig.standard_plans(seed=seed + 3, free=1, forced=2, rest=0, **ahead)
    trained, held_out = virtual_rig.record_many([(rig, plans, seed + 2), (rig, checks, seed + 4)])
    others = [dataclasses.replace(e, name=f"check_{e.name}") for e in held_out.experiments]
    recording = rtac.Recording((*trained.experiments, *others), rig=trained.rig)
    names = [e.name for e in others]
    found = est.improve(rtac.RTAC.from_rig(recording), recording, validation=names, progress=False)
    assert [c.id for c in found.added] == ["arm_stribeck"], found
    assert found.held == ("arm_stribeck",)
    assert found.diagnoses[-1].verdict == "adequate", found
    before, after = (m.errors for m in (found.validation.models[0], found.validation.models[-1]))
    assert sum(e.rms_over_noise for e in after.values()) < 0.95 * sum(e.rms_over_noise for e in before.values())
