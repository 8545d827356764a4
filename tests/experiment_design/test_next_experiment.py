"""What data leave open, the recommended experiment settles; the independent virtual rig carries it out."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.experiment_design.candidate_experiments import Limits, default_plans, feasible, held_alike
from estimators.experiment_design.next_experiment import ENOUGH
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect

TRAVEL, TORQUE, SPEED = 0.015, 0.1, 55.0
CHANNELS = ("cart_position", "arm_velocity")
# What the rig hides, and what it is taken for.
PAIRS = {
    "input_delay": (dict(input_delay=0.006), "current_lag"),
    "current_lag": (dict(current_lag=0.006), "input_delay"),
    "cart_quadratic_drag": (dict(cart_quadratic_drag=2.0), "cart_stribeck"),
    "cart_stribeck": (dict(cart_stribeck=0.02, cart_stribeck_velocity=0.01), "cart_quadratic_drag"),
    "gravity_tilt": (dict(tilt_across=0.01), "cogging"),
    "cogging": (dict(cogging_torque=1.5e-4, cogging_order=3.0), "gravity_tilt"),
}
OFFERED = [
    CATALOGUE[name]
    for name in (
        *PAIRS, "arm_coulomb", "cubic_spring", "tacho_lag", "dead_zone",
    )
]  # fmt: skip


def drawn(name: str, seed: int) -> tuple[virtual_rig.Rig, rtac.Recording]:
    """A rig with a hidden effect, and a short recording on it that shows little."""
    rig = dataclasses.replace(virtual_rig.Rig().drawn(seed), **PAIRS[name][0])
    plans = virtual_rig.standard_plans(
        seed=10 + seed, sample_time=0.01, duration=4.0, free=1, forced=2, rest=1, current_rms=0.02
    )
    return rig, virtual_rig.record(rig, plans, seed=20 + seed)


def diagnosed(recording: rtac.Recording, offered: Sequence[type[Effect]] = OFFERED) -> tuple[est.Fit, est.Diagnosis]:
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    return fit, est.diagnose(fit, recording, candidates=offered, progress=False)


def with_recommended(
    rig: virtual_rig.Rig, recording: rtac.Recording, plan: virtual_rig.Plan, seed: int
) -> rtac.Recording:
    new = virtual_rig.record(rig, [plan], seed=seed)
    return dataclasses.replace(recording, experiments=recording.experiments + new.experiments)


@dataclasses.dataclass(frozen=True)
class Case:
    rig: virtual_rig.Rig
    recording: rtac.Recording
    fit: est.Fit
    found: est.Diagnosis
    next: est.NextExperiment


@pytest.fixture(scope="module")
def delayed() -> Case:
    """A delayed current, which these data do not tell from a lag; with a few candidates, as each has to be compiled."""
    rig, recording = drawn("input_delay", 1)
    fit, found = diagnosed(recording, [CATALOGUE[name] for name in ("input_delay", "current_lag", "arm_coulomb")])
    assert found.verdict == "ambiguous"
    return Case(rig, recording, fit, found, est.next_experiment(fit, recording, found, progress=False))


@pytest.mark.slow
def test_lag_or_delay_is_settled_by_the_recommended_experiment(delayed: Case) -> None:
    among_all = diagnosed(delayed.recording)[1]
    assert among_all.verdict == "ambiguous"
    assert {c.id for c in among_all.effects} == {c.id for c in delayed.found.effects}
    assert {c.id for c in delayed.found.effects} == {"input_delay", "current_lag"} == set(delayed.next.effects)
    _, found = diagnosed(with_recommended(delayed.rig, delayed.recording, delayed.next.plan, 1001))
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == ["input_delay"], found
    assert found.effects[0].parameters["delay"].value == pytest.approx(0.006, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("separation", [100.0, 1000.0, 1e4])
def test_the_separation_that_is_predicted_is_the_one_that_is_recorded(delayed: Case, separation: float) -> None:
    planned = min(delayed.next.ranked, key=lambda one: abs(np.log(one.smallest / separation)))
    recording = with_recommended(delayed.rig, delayed.recording, planned.plan, 1002)
    known = {c.id: c for c in delayed.found.candidates}
    misfit = {}
    for name in ("input_delay", "current_lag"):
        effect = CATALOGUE[name](**{n: p.value for n, p in known[name].parameters.items()})
        fit = est.output_error(delayed.fit.model + effect, recording, from_model=True, progress=False)
        count = sum(e.samples for e in recording.experiments if e.kind != "rest")
        misfit[name] = sum(count * (fit.residual_std[c] / fit.noise[c]) ** 2 for c in fit.noise)
    shown = misfit["current_lag"] - misfit["input_delay"]
    assert 0.5 < planned.separation["input_delay", "current_lag"] / shown < 2.0


@pytest.mark.slow
def test_an_experiment_that_was_held_out_and_would_decide_is_named(delayed: Case) -> None:
    """The recommended experiment, recorded and then held out, as `Recording.split` may do; and one that says nothing."""
    plans = [
        delayed.next.plan,
        dataclasses.replace(virtual_rig.standard_plans(seed=5, free=1, forced=0)[0], name="decay"),
    ]
    spared = virtual_rig.record(delayed.rig, plans, seed=1003)
    fit, found, few = delayed.fit, delayed.found, [delayed.next.plan]
    again = [dataclasses.replace(plan, name="again") for plan in few]
    planned = est.next_experiment(fit, delayed.recording, found, plans=again, held_out=spared, progress=False)
    assert planned.deciding == (delayed.next.plan.name,)
    assert planned.held_out[delayed.next.plan.name] == pytest.approx(planned.best.smallest, rel=0.3)
    assert f"of what was held out, {delayed.next.plan.name} (" in str(planned)
    assert planned.as_dict()["held_out"] == planned.held_out
    assert "held out" not in str(delayed.next)


def test_where_a_larger_separation_is_passed_over_the_reason_is_said(delayed: Case) -> None:
    gentle, violent = (
        dataclasses.replace(delayed.next.best, separation={pair: size for pair in delayed.next.already})
        for size in (700.0, 2900.0)
    )
    said = "Of experiments that add more than 500 the gentlest for the rig comes first."
    assert said in str(dataclasses.replace(delayed.next, ranked=(gentle, violent)))
    assert said not in str(dataclasses.replace(delayed.next, ranked=(violent, gentle)))


def test_every_experiment_of_the_menu_keeps_to_the_limits_on_the_rig(delayed: Case) -> None:
    # As good as silent: a record in which a sensor shows nothing at all would be refused.
    silent = dataclasses.replace(delayed.rig, position_noise=1e-9, velocity_noise=1e-9, quantisation_bits=None)
    shown = virtual_rig.record(silent, [one.plan for one in delayed.next.ranked], seed=5)
    assert len(shown.experiments) > 40
    for e, one in zip(shown.experiments, delayed.next.ranked, strict=True):
        assert np.max(np.abs(e.outputs["cart_position"].values)) <= TRAVEL, e.name
        assert np.max(np.abs(e.outputs["arm_velocity"].values)) <= SPEED, e.name
        current = 0.0 if one.plan.current is None else np.max(np.abs(one.plan.current))
        assert delayed.rig.torque_constant * current <= 1.02 * TORQUE, e.name  # K_m is known from the fit only
        assert np.max(np.abs(e.outputs["cart_position"].values)) == pytest.approx(one.travel, rel=0.3, abs=2e-4), e.name


def test_the_ranking_is_by_what_is_separated_least_and_then_by_effort(delayed: Case) -> None:
    ranked = delayed.next.ranked
    enough = [one for one in ranked if one.smallest >= ENOUGH + min(delayed.next.already.values())]
    others = [one.smallest for one in ranked[len(enough) :]]
    assert list(ranked[: len(enough)]) == sorted(enough, key=lambda one: one.effort)
    assert others == sorted(others, reverse=True)
    assert enough
    assert delayed.next.best.smallest > 10 * min(delayed.next.already.values())
    assert all(set(one.separation) == set(delayed.next.already) for one in delayed.next.ranked)
    # More data never tell less.
    for pair, already in delayed.next.already.items():
        assert all(one.separation[pair] >= 0.999 * already for one in delayed.next.ranked)
    # A free decay has no current, which alone a lag or a delay acts on.
    for one in delayed.next.ranked:
        if one.plan.kind == "free":
            assert one.smallest < 1.5 * min(delayed.next.already.values()) + 5


def test_the_file_to_play_holds_the_inputs(delayed: Case, tmp_path: Path) -> None:
    delayed.next.save(tmp_path / "next.h5")
    played = rtac.measurement.Recording.load(tmp_path / "next.h5")
    assert [e.name for e in played.experiments] == [delayed.next.plan.name]
    np.testing.assert_array_equal(played.experiments[0].inputs["current"].values, delayed.next.current)
    assert "not measurements" in played.comment
    assert delayed.next.plan.name in str(delayed.next)
    summary = delayed.next.as_dict()
    assert summary["name"] == delayed.next.plan.name
    assert summary["ranked"][0]["smallest_separation"] == delayed.next.best.smallest
    figure = delayed.next.plot()
    assert delayed.next.plan.name in figure.get_suptitle().replace("\n", " ")


def test_a_menu_of_ones_own_is_not_altered_and_what_breaks_a_limit_is_refused(delayed: Case) -> None:
    wave = np.where((1.5 * 0.01 * np.arange(400) + 0.25) % 1 < 0.5, 0.1, -0.1)
    plans = [
        virtual_rig.Plan("gentle", "forced", 4.0, 0.01, wave),
        virtual_rig.Plan("too strong", "forced", 4.0, 0.01, 15 * wave),
        virtual_rig.Plan("too far", "free", 4.0, 0.01, initial_position=0.02),
    ]
    chosen = est.next_experiment(delayed.fit, delayed.recording, delayed.found, plans=plans, progress=False)
    assert [one.plan for one in chosen.ranked] == plans[:1]
    assert {text.split(":")[0] for text in chosen.refused} == {"too strong", "too far"}


@pytest.mark.slow
def test_a_menu_by_its_old_name_is_taken_and_one_of_which_nothing_is_left_is_refused(delayed: Case) -> None:
    wave = np.where((1.5 * 0.01 * np.arange(400) + 0.25) % 1 < 0.5, 0.1, -0.1)
    plans = [
        virtual_rig.Plan("gentle", "forced", 4.0, 0.01, wave),
        virtual_rig.Plan("too strong", "forced", 4.0, 0.01, 15 * wave),
    ]
    chosen = est.next_experiment(delayed.fit, delayed.recording, delayed.found, plans=plans, progress=False)
    with pytest.warns(DeprecationWarning, match="menu is called plans now"):
        old = est.next_experiment(delayed.fit, delayed.recording, delayed.found, menu=plans, progress=False)
    assert old.as_dict() == chosen.as_dict()
    with pytest.raises(ValueError, match="no experiment keeps to the limits"):
        est.next_experiment(delayed.fit, delayed.recording, delayed.found, plans=plans[1:], progress=False)


def test_a_limit_of_the_current_cuts_what_is_planned_and_the_names_say_so() -> None:
    model = rtac.RTAC.paper()
    limits = Limits(TRAVEL, TORQUE, SPEED, current=0.3)
    plans = default_plans(model, limits, sample_time=0.005, duration=4.0)
    free = default_plans(model, Limits(TRAVEL, TORQUE, SPEED), sample_time=0.005, duration=4.0)
    for plan in plans:
        largest = 0.0 if plan.current is None else np.max(np.abs(plan.current))
        assert largest <= 0.3
        assert (largest == 0.3) == (", cut at 0.3 A" in plan.name), plan.name
    assert len(plans) < len(free)  # squares that were larger than that are one
    currents = [(plan.start, plan.current.tobytes()) for plan in plans if plan.current is not None]
    assert len(set(currents)) == len(currents)
    found = feasible(model, plans, limits, lower=True, channels=CHANNELS)
    assert all(np.max(np.abs(plan.current)) <= 0.3 for plan in found.plans if plan.current is not None)
    assert any("lowered to" in plan.name for plan in found.plans)
    forced = [plan for plan in found.plans if plan.current is not None]
    for one, other in itertools.combinations(forced, 2):
        if one.start == other.start:
            apart = np.max(np.abs(one.current - other.current)) / np.max(np.abs(other.current))
            assert apart > 0.02, (one.name, other.name)


def test_a_cart_that_is_clamped_everywhere_stays_so_and_no_decay_is_planned() -> None:
    """Of a rig that shows the arm's speed alone a decay of the cart would show nothing, and was refused as an empty experiment."""
    model, limits = rtac.RTAC.paper(), Limits(TRAVEL, TORQUE, SPEED)
    plans = default_plans(model, limits, sample_time=0.005, duration=2.0)
    moving = [
        rtac.Experiment.of(
            "a",
            kind="forced",
            sample_time=0.005,
            arm_velocity=np.sin(np.arange(99.0)),
            current=np.ones(99),
            cart="clamped",
        )
    ]
    held = held_alike(plans, moving)
    assert {p.kind for p in held} == {"forced"}
    assert {p.cart for p in held} == {"clamped"}
    assert held_alike(plans, [*moving, dataclasses.replace(moving[0], cart="free")]) == plans
    locked = [dataclasses.replace(p, arm="locked") for p in plans if p.kind == "free"]
    seen, unseen = (feasible(model, locked, limits, lower=False, channels=[c]) for c in CHANNELS)
    assert (len(seen.plans), len(unseen.plans)) == (len(locked), 0)
    assert all("too weak to move anything" in why for why in unseen.refused)


def test_what_cannot_be_planned_is_refused(delayed: Case) -> None:
    given = (delayed.fit, delayed.recording, delayed.found)
    adequate = dataclasses.replace(delayed.found, verdict="adequate", effects=(), additions=())
    with pytest.raises(ValueError, match="nothing is to be told apart"):
        est.next_experiment(*given[:2], adequate, progress=False)
    decay = 0.01 * np.cos(0.1 * np.arange(200))
    locked = rtac.Recording(
        [rtac.Experiment.of("free", kind="free", sample_time=0.01, arm="locked", cart_position=decay)]
    )
    with pytest.raises(ValueError, match="the arm is locked in every experiment"):
        est.next_experiment(delayed.fit, locked, delayed.found, progress=False)
    with pytest.raises(ValueError, match="is no candidate of the diagnosis"):
        est.next_experiment(*given, between=["input_delay", "gremlins"], progress=False)
    with pytest.raises(ValueError, match="travel limit"):
        est.next_experiment(*given, travel=0.0, progress=False)
    with pytest.raises(ValueError, match="current limit"):
        est.next_experiment(*given, current_limit=-1.0, progress=False)
    with pytest.raises(ValueError, match="is empty"):
        est.next_experiment(*given, plans=[], progress=False)
    with pytest.raises(ValueError, match="give a list of names"):
        est.next_experiment(*given, between="input_delay", progress=False)
    with pytest.raises(ValueError, match="candidates: input_delay is not among them"):
        est.next_experiment(*given, candidates=[CATALOGUE["current_lag"]], between=["input_delay"], progress=False)
    unshown = next(c.id for c in delayed.found.candidates if not c.refitted)
    blind = dataclasses.replace(
        delayed.found, candidates=tuple(dataclasses.replace(c, testable=False) for c in delayed.found.candidates)
    )
    with pytest.raises(ValueError, match=f"nothing in the recording could show {unshown}"):
        est.next_experiment(*given[:2], blind, between=["input_delay", unshown], progress=False)
    still = virtual_rig.Plan("still", "forced", 4.0, 0.01, np.ones(400), arm="locked", cart="clamped")
    with pytest.raises(ValueError, match="in still the arm is locked and the cart clamped"):
        est.next_experiment(*given, plans=[still], progress=False)
    taken = virtual_rig.Plan("forced_1", "free", 4.0, 0.01, initial_position=0.01)
    with pytest.raises(ValueError, match="has forced_1 already"):
        est.next_experiment(*given, plans=[taken], progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cart_quadratic_drag", "gravity_tilt"])
def test_other_pairs_are_settled_too(name: str) -> None:
    assert settled(name, 1), name


@pytest.mark.slow
@pytest.mark.parametrize("pair", [("input_delay", "current_lag"), ("cart_quadratic_drag", "cart_stribeck"),
                                  ("gravity_tilt", "cogging")])  # fmt: skip
def test_nine_of_ten_are_right_after_the_recommended_experiment(pair: tuple[str, str]) -> None:
    right = [settled(pair[draw % 2], 100 + draw) for draw in range(10)]
    assert sum(right) >= 9, right


def settled(name: str, seed: int) -> bool:
    """Whether after the recommended experiment the diagnosis names what is hidden, and nothing else."""
    rig, recording = drawn(name, seed)
    fit, found = diagnosed(recording)
    chosen = est.next_experiment(fit, recording, found, between=[name, PAIRS[name][1]], progress=False)
    _, then = diagnosed(with_recommended(rig, recording, chosen.plan, 1000 + seed))
    return then.verdict == "missing" and [c.id for c in then.effects] == [name]
