"""The loop goes on with the effect that explains most of what a diagnosis cannot name: two may hide each other."""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import Any

import made_up_results
import pytest
from made_up_loop import added, made, new_loop

import estimators as est
import rtac_jax as rtac
from estimators.core.deadline import Deadline
from estimators.diagnosis import improvement_loop, loop_run
from estimators.diagnosis import read_law as read_law_module
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.read_law import ReadLaw
from estimators.inference.simulation_residual import SimulationResidual
from estimators.misspecification.adequacy import AdequacyTest
from estimators.misspecification.equation_curves import EquationCurve
from estimators.misspecification.force_formulas import Formula
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, ArmCoulomb, Effect, InputDelay
from rtac_jax.effects.one_sided_spring import OneSidedSpring

NEAREST = made_up_results.candidate("input_delay", 564.0, error_reduction=0.68)
BESIDE = made_up_results.candidate("arm_coulomb", 900.0)
CURVE = made_up_results.curve("cart", "cart_position", 0.01)


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    """A loop that stopped at an unknown base model; with a delay in it a diagnosis names dry friction of the arm."""

    def diagnosed(fit: est.Fit, *_: Any, **__: Any) -> est.Diagnosis:
        named = "input_delay" in fit.model and "arm_coulomb" not in fit.model
        rest = "adequate" if "arm_coulomb" in fit.model else "unknown"
        return made(
            est.Diagnosis, verdict="missing" if named else rest, effects=(BESIDE,) if named else (),
            additions=(ArmCoulomb(3e-3),) if named else (), left=(), simulation=None, candidates=(), curves=(), tests=(),
        )  # fmt: skip

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    monkeypatch.setattr(improvement_loop, "add_effects", extended)
    begun = new_loop()
    loop_run.run(begun)
    return begun


def extended(before: est.Fit, tested: Any, several: Sequence[Effect], *_: Any, **__: Any) -> Added:
    return added(reduce(rtac.RTAC.__add__, several, before.model))


def test_what_hides_behind_the_nearest_effect_is_found(loop: Loop) -> None:
    assert loop.stopped == "Stopped: no effect of the catalogue explains what is missing."
    further = loop_run.with_nearest(loop, added(loop.last.fit.model + InputDelay(4e-3)), NEAREST)
    assert further is not None
    assert [c.id for c in further.added] == ["input_delay", "arm_coulomb"]
    assert [ids for ids, _ in further.steps] == [(), ("input_delay",), ("arm_coulomb",)]
    assert [d.verdict for d in further.diagnoses] == ["unknown", "missing", "adequate"]
    assert further.stopped == (
        "input_delay alone explained 68 % of what was left; with arm_coulomb it explains all. Stopped: nothing more is missing."
    )
    assert (len(loop.steps), len(loop.diagnoses), loop.added) == (1, 1, [])
    whole = dataclasses.replace(
        made_up_results.improvement(), diagnoses=tuple(further.diagnoses), added=tuple(further.added),
        diagnosed=tuple(further.diagnosed),
    )  # fmt: skip
    assert [whole.fitted_before(n) for n in range(3)] == [0, 1, 2]
    assert whole.mended == "adequate"


def test_where_it_leads_no_further_it_is_a_last_resort(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a lag of the current stands for what is in no catalogue."""
    monkeypatch.setattr(loop_run, "learn_force", lambda *_, **__: "No force was learned.")
    near = added(loop.last.fit.model + rtac.effects.CurrentLag(1e-3)), dataclasses.replace(NEAREST, id="current_lag")
    assert loop_run.with_nearest(loop, *near) is None
    assert loop_run.last_resorted(loop, (near[0], near[1])) == (near[1], None)
    assert [ids for ids, _ in loop.steps] == [(), ("current_lag",)]
    assert loop.added == []


@pytest.mark.parametrize(
    ("serve", "most", "steps", "stopped"),
    [
        ("together", 4, [(), ("arm_coulomb", "input_delay")], "Stopped: nothing more is missing."),
        ("alone", 4, [(), ("arm_coulomb",), ("input_delay",)], "Stopped: nothing more is missing."),
        ("none", 4, [()], "Stopped: it would not fall."),
        ("together", 1, [(), ("arm_coulomb",)], "Stopped: 1 effects were added; more seem to be missing."),
    ],
)
def test_what_a_diagnosis_names_is_added_together_or_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, serve: str, most: int, steps: list[tuple[str, ...]], stopped: str
) -> None:
    several = (ArmCoulomb(3e-3), InputDelay(4e-3))
    effects = (BESIDE, NEAREST)

    def diagnosed(fit: est.Fit, *_: Any, **__: Any) -> est.Diagnosis:
        if len(fit.model.effects) > len(rtac.RTAC.paper().effects):
            return made(est.Diagnosis, verdict="adequate", effects=(), additions=(), simulation=None)
        return made(est.Diagnosis, verdict="missing", effects=effects, additions=several, simulation=None)

    def tried(before: est.Fit, tested: Any, given: Sequence[Effect], *_: Any, **__: Any) -> Added | str:
        served = serve == "together" or (serve == "alone" and len(given) == 1)
        return extended(before, tested, given) if served else "Stopped: it would not fall."

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    monkeypatch.setattr(improvement_loop, "add_effects", tried)
    loop = new_loop(most)
    loop_run.run(loop)
    assert [ids for ids, _ in loop.steps] == steps
    assert [c.id for c in loop.added] == [i for ids in steps for i in ids]
    assert loop.stopped == stopped
    assert loop.diagnosed == ([0] if len(steps) == 1 or most == 1 else [0, len(steps) - 1])


@pytest.mark.parametrize(
    ("port", "variable", "known", "asked"),
    [
        ("cart", "cart_position", (), True),
        ("cart", "cart_velocity", (), False),
        ("arm", "arm_angle", (), False),
        ("cart", "cart_position", ("one_sided_spring",), False),
    ],
)
def test_a_force_against_the_position_that_is_in_no_catalogue_is_looked_for_beyond(
    monkeypatch: pytest.MonkeyPatch, port: str, variable: str, known: tuple[str, ...], asked: bool
) -> None:
    """Unless the diagnosis offered it already, as where the fit of the model follows nothing."""
    curve = made_up_results.curve(port, variable, 0.01)
    test = made_up_results.AdequacyTest("static force", 1e-9, curve.excess, 2e-3, "of it", alarmed=True)
    offered = []

    def diagnosed(fit: est.Fit, *_: Any, candidates: Sequence[type[Effect]] | None, **__: Any) -> est.Diagnosis:
        offered.append(None if candidates is None else [c.id for c in candidates])
        if "one_sided_spring" in fit.model:
            return made(
                est.Diagnosis,
                verdict="adequate",
                effects=(),
                additions=(),
                simulation=None,
                curves=(),
                tests=(),
                candidates=(),
            )
        if candidates is not None:
            effects = (made_up_results.candidate("one_sided_spring", 50.0),)
            return made(
                est.Diagnosis, verdict="missing", effects=effects, additions=(OneSidedSpring(30.0),), simulation=None
            )
        several = tuple(made_up_results.candidate(name, 1.0) for name in known)
        return made(
            est.Diagnosis, verdict="unknown", effects=(), additions=(), simulation=None, curves=(curve,), tests=(test,),
            candidates=several,
        )  # fmt: skip

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    monkeypatch.setattr(improvement_loop, "add_effects", extended)
    loop = new_loop()
    loop_run.run(loop)
    assert offered == ([None, ["one_sided_spring"], None] if asked else [None])
    assert [c.id for c in loop.added] == (["one_sided_spring"] if asked else [])


@pytest.mark.parametrize(
    ("verdict", "left", "cause", "kept"),
    [
        ("adequate", 4.0, None, True),
        ("unknown", 0.5, None, True),  # beside the noise itself: at it, though a test rejects
        ("unknown", 1.2, None, False),
        ("adequate", 0.5, "stand-in", False),  # random forces stand in for the physics, and no equation tells it
        ("adequate", 4.0, "equations", True),  # here one does
        ("adequate", 0.5, "drift", False),
    ],
)
def test_a_law_stays_where_nothing_more_is_missing_or_it_follows_to_the_noise(
    monkeypatch: pytest.MonkeyPatch, verdict: str, left: float, cause: Any, kept: bool
) -> None:
    """It takes the place of a force, and what was added beside that stays."""
    loop = new_loop()
    before = Added(loop.last.fit, made_up_results.compared("+ end_stop, current_lag", 5.0), "simulated")
    loop.steps = [((), before), (("end_stop", "current_lag"), before)]
    loop.added = [made_up_results.candidate(name, 50.0) for name in ("end_stop", "current_lag")]
    residual = made(SimulationResidual, cause="stand-in") if cause in ("stand-in", "equations") else None
    by_equations = [EquationCurve(CURVE, {}, 0.9)] if cause == "equations" else []
    monkeypatch.setattr(loop_run, "significant_equation_curves", lambda *_, alone: by_equations)
    left_over = (AdequacyTest("drift", 1e-9, 400.0, 2e-3, "a friction that falls"),) if cause == "drift" else ()
    last = dataclasses.replace(made_up_results.diagnosis("unknown"), simulation=residual, left=left_over)
    loop.diagnoses, loop.diagnosed = [last], [1]
    law = made_up_results.candidate("law_of_cart_position_power5", 90.0)
    with_it = dataclasses.replace(before, tested=made_up_results.compared("+ current_lag, law", left))
    asked: list[tuple[str, ...]] = []

    def read(_: Added, added: Sequence[Any], *__: Any, **___: Any) -> ReadLaw:
        asked.append(tuple(c.id for c in added))
        return ReadLaw(with_it, law, made(Formula), ("end_stop",), CURVE)

    monkeypatch.setattr(loop_run, "static_force", lambda *_: (CURVE, True))
    monkeypatch.setattr(loop_run, "read_law", read)
    monkeypatch.setattr(read_law_module, "_text", lambda *_: "a force")
    monkeypatch.setattr(Loop, "diagnosed_again", lambda *_, **__: made_up_results.diagnosis(verdict))
    further = loop_run.with_law(loop)
    assert asked == ([] if cause in ("stand-in", "drift") else [("end_stop", "current_lag")])
    assert [c.id for c in loop.added] == ["end_stop", "current_lag"]
    if not kept:
        assert further is None
        return
    assert further is not None
    assert [c.id for c in further.added] == ["current_lag", law.id]
    assert further.steps[-1] == ((law.id,), with_it)
    assert "and takes the place of end_stop: the held-out experiments were left at" in further.stopped


@pytest.mark.parametrize(
    ("before", "read", "after", "taken"),
    [
        ("adequate", True, "adequate", True),
        ("adequate", True, "unknown", False),
        ("adequate", False, "adequate", False),
        ("unknown", True, "adequate", False),
    ],
)
def test_a_simpler_law_stays_where_the_model_with_it_is_adequate_too(
    monkeypatch: pytest.MonkeyPatch, before: str, read: bool, after: str, taken: bool
) -> None:
    loop = new_loop()
    last = Added(loop.last.fit, made_up_results.compared("+ end_stop", 1.1), "simulated")
    loop.steps.append((("end_stop",), last))
    loop.added, loop.diagnosed = [made_up_results.candidate("end_stop", 50.0)], [0, 1]
    loop.diagnoses = [made_up_results.diagnosis("missing"), made_up_results.diagnosis(before)]
    law = made_up_results.candidate("law_of_cart_position_power5", 90.0)
    found = ReadLaw(
        dataclasses.replace(last, tested=made_up_results.compared("+ law", 1.0)),
        law,
        made(Formula),
        ("end_stop",),
        CURVE,
    )
    monkeypatch.setattr(read_law_module, "_text", lambda *_: "a force")
    monkeypatch.setattr(loop_run, "simpler_law", lambda *_, **__: found if read else None)
    monkeypatch.setattr(Loop, "diagnosed_again", lambda *_, **__: made_up_results.diagnosis(after))
    further = loop_run.with_simpler_law(loop)
    assert (further is not None) == taken
    if further is not None:
        assert further.added == [law]
        assert further.diagnosed == [0, 1, 2]
        assert further.stopped.startswith(
            "a force is a law read off the missing force, in no catalogue, and takes the place of"
        )
        assert loop.added[0].id == "end_stop"


@pytest.mark.slow
def test_two_effects_of_one_diagnosis_are_fitted_together() -> None:
    """A spring that hardens and dry friction of the arm, in the virtual rig."""
    rig = virtual_rig.Rig(cubic_spring=5e4, arm_coulomb=4e-4)
    plans = virtual_rig.standard_plans(seed=61, sample_time=0.01, duration=4.0, free=2, forced=4, rest=1)
    recording = virtual_rig.record(rig, plans, seed=71)
    several = [CATALOGUE[name] for name in ("cubic_spring", "arm_coulomb", "current_lag", "lvdt_nonlinearity")]
    found = est.improve(rtac.RTAC.from_rig(recording), recording, candidates=several, progress=False)
    assert [model.label for model in found.validation.models] == ["base", "+ arm_coulomb, cubic_spring"]
    assert (found.diagnosed, found.mended) == ((0, 1), "adequate")
    for name, truth in (("cubic_spring.stiffness", 5e4), ("arm_coulomb.level", 4e-4)):
        assert abs(found.final.parameters[name].value - truth) < 4 * found.final.parameters[name].std
        assert found.final.parameters[name].std < 0.02 * truth


@pytest.mark.slow
def test_dry_friction_of_the_arm_and_a_delay_hide_each_other() -> None:
    """On an encoder, without a rest record, where half of the torque is dry friction."""
    rig = virtual_rig.Rig(
        total_mass=1.0, spring_stiffness=157.9, cart_viscous=0.5, cart_coulomb=0.0, eccentric_moment=3e-3, arm_inertia=2.1e-4,
        torque_constant=0.1, arm_viscous_positive=4e-4, arm_viscous_negative=4e-4, arm_coulomb=3e-3, input_delay=4e-3,
        encoder=True,
    )  # fmt: skip
    plans = virtual_rig.standard_plans(
        seed=2, sample_time=0.004, duration=6.0, free=1, forced=3, rest=0, current_rms=0.5, largest_current=5.0
    )
    recording = virtual_rig.record(rig, plans, seed=2)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert {c.id for c in found.added} == {"input_delay", "arm_coulomb"}, found
    assert found.mended == "adequate"
    assert found.final.parameters["input_delay.delay"].value == pytest.approx(4e-3, rel=0.05)
    assert found.final.parameters["arm_coulomb.level"].value == pytest.approx(3e-3, rel=0.05)


def test_after_the_time_is_over_nothing_is_diagnosed_any_more(monkeypatch):
    def diagnosed(*_, **__):
        raise AssertionError("diagnosed again")

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    one = dataclasses.replace(new_loop(), diagnoses=[made_up_results.diagnosis("missing")], deadline=Deadline(0.0))
    loop_run.run(one)
    assert one.out_of_time
    assert one.stopped == improvement_loop.OUT_OF_TIME


@pytest.mark.parametrize(("error", "kept"), [(1.5, True), (2.9, False)])
def test_what_a_part_chose_is_fitted_to_all_samples_and_stays_where_it_serves(
    monkeypatch: pytest.MonkeyPatch, error: float, kept: bool
) -> None:
    before, part = made_up_results.compared("base", 3.0), made(rtac.Recording)
    loop = dataclasses.replace(new_loop(), part=part)
    loop.steps[0] = (), dataclasses.replace(loop.last, tested=before)
    chosen = dataclasses.replace(loop.last, tested=made_up_results.compared("+ law", 1.4))
    whole = dataclasses.replace(chosen, tested=made_up_results.compared("+ law", error))
    asked: list[tuple[str, rtac.Recording]] = []

    def fitted(_: Any, lost: Any, more: Any, label: str, train: rtac.Recording, *__: Any, **___: Any) -> Any:
        assert not lost
        assert not more
        asked.append((label, train))
        return whole

    monkeypatch.setattr(improvement_loop, "extended_without", fitted)
    assert loop.choosing is part
    assert (loop.of_all(chosen) is whole) == kept
    assert asked == [("+ law", loop.train)], asked
    short = dataclasses.replace(loop, part=None)
    assert short.choosing is short.train
    assert short.of_all(chosen) is chosen, "all samples have chosen it"
