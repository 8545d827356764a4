"""One experiment at fault, in recordings of the independent virtual rig and of oscillators in closed form."""

import dataclasses

import numpy as np
import pytest
from command_line import call
from made_up_results import compared, diagnosis
from scipy.integrate import solve_ivp

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import information_of
from estimators.core.results import RESULTS
from estimators.diagnosis import improvement_loop, loop_end
from estimators.diagnosis.loop_end import end_of, without_outlier
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.policy import STANDARD
from estimators.linear.homogeneity_test import Equality, Trend
from estimators.linear.outlier import Outlier, rounded
from estimators.plots.improvement import finding, plot_improvement
from estimators.validation.differing_experiments import differing, may_show_alone
from estimators.validation.simulation_error import Comparison
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, CubicSpring, EndStop
from rtac_jax.measurement import Signal

RIG = virtual_rig.Rig()
LATE = "forced_2"


def recorded(rig=RIG):
    plans = virtual_rig.standard_plans(seed=61, sample_time=0.01, duration=4.0, free=2, forced=4, rest=1)
    return virtual_rig.record(rig, plans, seed=71)


def changed(recording, name, change):
    """Return the recording with one of its experiments changed."""
    return dataclasses.replace(recording, experiments=tuple(change(e) if e.name == name else e for e in recording))


def late(experiment, samples=6):
    """Return an experiment whose current comes so many samples late."""
    current = experiment.inputs["current"].values
    moved = np.concatenate([np.zeros(samples), current[:-samples]])
    return dataclasses.replace(
        experiment, inputs={"current": dataclasses.replace(experiment.inputs["current"], values=moved)}
    )


def scaled(experiment, factor=1.03):
    """Return an experiment whose cart sensor reads too much."""
    signal = experiment.outputs["cart_position"]
    wrong = Signal(factor * signal.values, signal.unit, signal.noise_std)
    return dataclasses.replace(experiment, outputs=experiment.outputs | {"cart_position": wrong})


@pytest.fixture(scope="module")
def recording():
    return changed(recorded(), LATE, late)


@pytest.fixture(scope="module")
def improved(recording):
    return est.improve(
        rtac.RTAC.from_rig(recording), recording, candidates=[CubicSpring], thorough=False, progress=False
    )


@pytest.mark.slow
def test_an_effect_that_makes_up_for_a_drift_is_taken_back():
    """The spring softens and friction falls from run to run; a stop at the ends of the travel left 7 times the noise."""
    rig = RIG.drawn(6)
    plans = virtual_rig.standard_plans(seed=6, sample_time=0.005, duration=4.0, free=2, forced=4, rest=1)
    recording = virtual_rig.record(rig, plans, seed=13)
    moving = [plan.name for plan in plans if plan.kind != "rest"]
    for run, name in enumerate(moving):
        now = dataclasses.replace(
            rig,
            spring_stiffness=rig.spring_stiffness * (1 - 0.02 * run),
            arm_viscous_positive=rig.arm_viscous_positive * (1 - 0.08 * run),
            arm_viscous_negative=rig.arm_viscous_negative * (1 - 0.08 * run),
        )
        there = virtual_rig.record(now, plans, seed=13)[name]
        recording = changed(recording, name, lambda _, there=there: there)
    model = rtac.RTAC.from_rig(recording)
    improved = est.improve(model, recording, candidates=[EndStop], progress=False)
    assert [c.id for c in improved.diagnoses[0].effects] == ["end_stop"]
    assert not improved.added
    assert improved.verdict == "unknown"
    assert improved.constancy is not None
    assert set(improved.constancy.varying) == {"spring_stiffness", "arm_viscous.positive", "arm_viscous.negative"}
    assert improved.stopped.startswith("Not kept: end_stop, with which a simulation is left at")
    assert "Experiments differ" in improved.headline
    assert improved.headline.endswith("and what the diagnosis names explains less.")
    assert finding(improved).startswith("Experiments differ in spring_stiffness and arm_viscous")


@pytest.mark.slow
def test_the_last_model_is_fitted_without_it_and_nothing_is_learned_from_it(improved):
    assert improved.left_out == LATE
    assert improved.base.farthest > 20.0
    assert improved.final.farthest < 1.2
    assert improved.learned is None
    assert improved.nearest is None
    assert LATE not in improved.final.experiments
    for name, truth in (("torque_constant", RIG.torque_constant), ("spring_stiffness", RIG.spring_stiffness)):
        found = improved.final.parameters[name]
        assert abs(found.value - truth) < 4 * found.std, name
        assert abs(found.value - truth) < 0.01 * truth, name


@pytest.mark.slow
def test_it_is_said_with_what_all_others_leave_of_it(improved):
    one = improved.constancy.outlying
    assert one.left > 20.0
    assert f"All experiments but {LATE} are followed to {one.over_noise:.2f} times the noise" in improved.headline
    assert f"which leaves {one.channel} of {LATE} at {rounded(one.left)} times the noise" in improved.headline
    assert f"With {LATE} the model fails" in improved.headline
    assert "learned force" not in improved.headline
    assert f"The last model is fitted without {LATE}" in improved.ending
    assert not [t for model in improved.train.models for t in model.traces if t.experiment == LATE]


@pytest.mark.slow
def test_pictures_say_so(improved):
    assert finding(improved).startswith(f"Leaving {LATE} out of the fit lowers the held-out error of")
    figure = plot_improvement(improved)
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["base", f"without {LATE}"]


@pytest.mark.slow
def test_the_report_says_so(improved, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(est, "improve", lambda *_, **__: improved)
    recording.save(tmp_path / "rig.h5")
    result = call("improve", tmp_path / "rig.h5", "--out", tmp_path / "out")
    assert result.exit_code == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"{LATE} alone differs from all other experiments, and the last model is fitted without it" in page


@pytest.mark.slow
def test_one_whose_sensor_reads_three_percent_too_much_is_found_beside_the_noise():
    """Two experiments take most of the differences with them; only without the right one are the others alike."""
    recording = changed(recorded(), LATE, scaled)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = differing(fit, recording, least=0.0)
    assert found is not None
    assert found.outlying is not None
    assert found.outlying.decisive
    assert found.outlying.name == LATE
    assert found.outlying.channel == "cart_position"


@pytest.mark.slow
def test_a_missing_effect_is_no_fault_of_one_experiment():
    recording = recorded(dataclasses.replace(RIG, cubic_spring=5e4))
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = differing(fit, recording, least=0.0)
    assert found is None or found.outlying is None or not found.outlying.decisive


ONE = Outlier("d", 1.0, 3, None, 1.02, 30.0, "cart_position")


@pytest.fixture
def loop(monkeypatch):
    """A loop that names nothing and finds one outlying experiment; held-out errors are made up."""
    train = rtac.Recording([decay("a", 0.01), decay("b", 0.012), decay("c", 0.011), decay("d", 0.018)])
    model = rtac.RTAC.paper()
    known = information_of(np.eye(1), ("total_mass",), np.ones(1))
    others = est.Fit(model, RESULTS.successful, known, {}, {}, {}, ("a", "b", "c"), {})
    found = dataclasses.replace(
        Equality(
            ("total_mass",), ("kg",), ("a", "b", "c", "d"), np.ones((4, 1)), np.ones((4, 1)), np.ones(1), np.ones(1), 90.0, 3,
            0.0, np.zeros(1), ((),), {}, (), 0.01,
        ),
        outlying=dataclasses.replace(ONE, fit=others),
    )  # fmt: skip
    monkeypatch.setattr(loop_end, "differing", lambda *_, **__: found)
    monkeypatch.setattr(loop_end, "compare", lambda *_, **__: Comparison((compared("without d", 1.0),)))
    nothing = dataclasses.replace(diagnosis("unknown"), effects=(), additions=())
    first = Added(dataclasses.replace(others, experiments=("a", "b", "c", "d")), compared("base", 9.0), "simulated")
    return improvement_loop.Loop(
        train, train, None, 4, True, STANDARD, False, [((), first)], diagnoses=[nothing], diagnosed=[0]
    )


def decay(name, size):
    return rtac.Experiment.of(
        name, kind="free", sample_time=0.01, arm="locked", cart_position=size * np.cos(0.2 * np.arange(99))
    )


def test_it_is_left_out_where_nothing_is_named_and_the_held_out_ones_do_not_lose(loop):
    assert without_outlier(loop).outlying.name == "d"
    assert loop.left_out == "d"
    assert loop.last.tested.label == "without d"
    assert [e.name for e in loop.followed] == ["a", "b", "c"]


def test_it_is_told_and_not_left_out_where_it_may_show_an_effect(loop, monkeypatch):
    """Named by a diagnosis, or in the model, or shown by the one experiment that swings far; or where held-out ones lose."""
    far = rtac.Recording([*(e for e in loop.train if e.name != "d"), decay("d", 0.05)])
    assert not may_show_alone(loop.train, ONE)
    assert may_show_alone(far, ONE)
    assert not may_show_alone(far, dataclasses.replace(ONE, left=100.0)), "the others would show it, too"
    named = dataclasses.replace(loop.diagnoses[0], additions=(CubicSpring(5e4),))
    for change in ({"train": far}, {"diagnoses": [named]}, {"added": [diagnosis("missing").effects[0]]}):
        other = dataclasses.replace(loop, **change)
        assert without_outlier(other).outlying.name == "d"
        assert (other.left_out, len(other.steps)) == (None, 1), change
    assert without_outlier(loop, leave=False) is not None
    monkeypatch.setattr(loop_end, "compare", lambda *_, **__: Comparison((compared("without d", 9.5),)))
    assert without_outlier(loop).outlying.name == "d"
    assert (loop.left_out, len(loop.steps)) == (None, 1)


@pytest.mark.slow
def test_the_one_decay_that_swings_far_is_not_left_out():
    """A spring that hardens, and nobody offers: only that decay shows it."""
    rig = virtual_rig.Rig(cubic_spring=3e4)
    free, rest = virtual_rig.standard_plans(seed=1, duration=3.0, free=1, forced=0, rest=1)
    sizes = (0.003, 0.0032, 0.0034, 0.02, 0.0036, 0.0038)
    plans = [dataclasses.replace(free, name=f"free_{n}", initial_position=size) for n, size in enumerate(sizes)]
    recording = virtual_rig.record(rig, [*plans, rest], seed=4)
    found = est.improve(
        rtac.RTAC.from_rig(recording), recording, validation=["free_4", "free_5"], candidates=[CATALOGUE["tacho_bias"]],
        progress=False,
    )  # fmt: skip
    assert found.base.farthest > 3
    assert found.left_out is None
    assert "free_3" in found.final.experiments


def braked(name, size, seed, *, drag=2000.0):
    """Record the decay of a cart alone whose drag grows as the square of its position, by SciPy."""
    mass, stiffness, viscous, step = 1.2, 130.0, 0.3, 0.01

    def rate(_, state):
        q, v = state
        return [v, -(stiffness * q + (viscous + drag * q**2) * v) / mass]

    time = step * np.arange(400)
    found = solve_ivp(rate, (0.0, time[-1]), [size, 0.0], t_eval=time, rtol=1e-9, atol=1e-12)
    noise = 1e-5 * np.random.default_rng(seed).standard_normal(len(time))
    return rtac.Experiment.of(name, kind="free", sample_time=step, arm="locked", cart_position=found.y[0] + noise)


@pytest.mark.slow
def test_the_one_decay_that_shows_a_drag_is_not_blamed_where_a_learned_force_serves_better():
    """All but one are followed without the drag, which grows as a power of the motion and hides in their damping."""
    sizes = (0.006, 0.0061, 0.012, 0.0059, 0.006, 0.0061)
    recording = rtac.Recording([braked(f"free_{n}", size, n) for n, size in enumerate(sizes)], rig={"total_mass": 1.2})
    found = est.improve(
        rtac.RTAC.from_rig(recording).without("cart_coulomb"), recording, validation=["free_1", "free_5"],
        candidates=[CubicSpring], progress=False,
    )  # fmt: skip
    assert found.base.farthest > 3
    assert found.left_out is None
    assert "free_2" not in found.headline
    assert found.learned is not None
    assert found.learned.port == "cart"
    before, after = (model.errors["cart_position"].rms_over_noise for model in found.validation.models)
    assert after < 0.7 * before


@pytest.mark.parametrize(("covariate", "resorts"), [("time", False), ("amplitude", True)])
def test_no_last_resort_takes_the_place_of_a_parameter_that_differs(loop, monkeypatch, covariate, resorts):
    """But what goes with the motion is an effect that the model lacks, as a spring that hardens."""
    differs = Equality(
        ("total_mass",), ("kg",), ("a", "b", "c", "d"), np.ones((4, 1)), np.ones((4, 1)), np.ones(1), np.ones(1), 90.0, 3, 0.0,
        np.zeros(1), ((Trend(covariate, 1.0, 0.01, 0.99, 1e-6),),), {}, (), 0.01, varying=("total_mass",), explained=1.0,
        over_noise={"cart_position": 1.1},
    )  # fmt: skip
    assert differs.decisive
    asked = []
    monkeypatch.setattr(loop_end, "differing", lambda *_, **__: differs)
    monkeypatch.setattr(loop_end, "nearest", lambda _: None)
    monkeypatch.setattr(loop_end, "last_resorted", lambda *_: asked.append(1) or (None, None))
    found = end_of(loop, last_resort=True)
    assert bool(asked) == resorts
    assert found.differs is differs
