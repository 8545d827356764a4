"""Every usual mistake is named, in one experiment or in all; clean recordings, with hidden effects or without, are not accused."""

import dataclasses
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from spoilt_recordings import (
    FORCED,
    FREE,
    MOMENTARY,
    OF_CHANNELS,
    OF_THE_RIG,
    POSITION,
    VELOCITY,
    changed,
    everywhere,
    in_one,
    swapped,
    with_rig,
)

import estimators as est
import rtac_jax as rtac
from estimators.validation import arm_kinematics
from estimators.validation.cart_offset import offset_of_all
from estimators.validation.channel_consistency import _likeliest, _Search, _undone
from estimators.validation.equation_error import COEFFICIENTS, solve
from estimators.validation.equilibrium import is_held
from estimators.validation.mistakes import delays, usual_mistakes
from rtac_jax import virtual_rig
from rtac_jax.measurement import concerns, moving_at_rest

STUDY = Path(__file__).parents[2] / "studies" / "diagnosis.toml"


@pytest.fixture(scope="module")
def recordings():
    """Without and with an encoder; nothing hidden."""
    jobs = []
    for number, encoder in enumerate((False, True)):
        rig = dataclasses.replace(virtual_rig.Rig().drawn(100 + number), encoder=encoder)
        plans = virtual_rig.standard_plans(seed=200 + number, duration=4.0, free=2, forced=3)
        jobs.append((rig, plans, 300 + number))
    return virtual_rig.record_many(jobs, step=5e-4)


@pytest.fixture(scope="module")
def clean(recordings):
    return recordings[0]


# One of a kind, quick where it is in one experiment; the others are where they are in all. The rest is in slow studies.
OF_A_KIND = ("position in mm", "sign of current", "swapped channels", "sample time doubled", "angle in degrees", "offset of 5 mm",
             "velocity late")  # fmt: skip


@pytest.mark.parametrize(
    "mistake", [pytest.param(name, marks=[pytest.mark.slow] * (name in OF_A_KIND)) for name in OF_CHANNELS]
)
def test_a_mistake_in_all_experiments_is_named(clean, mistake):
    change, words = OF_CHANNELS[mistake]
    found = est.channel_consistency(everywhere(clean, change))
    assert len(found.concerns) == 1, found
    having = {"sign of current", "swapped current", "current as force", "current late"}
    assert found.concerns[0].startswith("forced_1, forced_2, forced_3: " if mistake in having else "all experiments: ")
    assert words in found.concerns[0]


@pytest.mark.parametrize(
    "mistake", [pytest.param(name, marks=[pytest.mark.slow] * (name not in OF_A_KIND)) for name in OF_CHANNELS]
)
def test_a_mistake_in_one_experiment_is_named(clean, mistake):
    change, words = OF_CHANNELS[mistake]
    found = est.channel_consistency(in_one(clean, FORCED, change))
    assert len(found.concerns) == 1, found
    sentence = found.concerns[0]
    assert sentence.startswith(f"experiment {FORCED} disagrees with all others; leaving it out takes the residual")
    assert words in sentence
    assert found.found[0].after < 1.5 < found.found[0].before
    assert f"{found.found[0].before:.3g} to {found.found[0].after:.3g} times the noise" in sentence


@pytest.mark.parametrize(
    "mistake",
    [
        "position in mm",
        *(
            pytest.param(m, marks=pytest.mark.slow)
            for m in ("velocity in rpm", "sign of velocity", "sample time doubled")
        ),
    ],
)
def test_a_mistake_in_a_free_decay_is_named(clean, mistake):
    change, words = OF_CHANNELS[mistake]
    found = est.channel_consistency(in_one(clean, FREE, change))
    assert [one.experiment for one in found.found] == [FREE]
    assert words in found.concerns[0]


@pytest.mark.parametrize(
    "mistake", [pytest.param(name, marks=[pytest.mark.slow] * (name != "mass in grams")) for name in OF_THE_RIG]
)
def test_a_wrong_constant_is_named(recordings, mistake):
    factors, words = OF_THE_RIG[mistake]
    for recording in recordings:
        found = est.channel_consistency(with_rig(recording, **factors))
        assert len(found.concerns) == 1, found
        assert words in found.concerns[0]
        assert "only the ratio of total_mass to arm_inertia shows" in found.concerns[0]


@pytest.mark.parametrize("mistake", MOMENTARY)
def test_a_momentary_fault_and_a_wrong_kind_are_named_without_a_fit(clean, mistake):
    name, change, words = MOMENTARY[mistake]
    before = concerns(clean)
    assert not any(words in said for said in before)
    assert any(words in said for said in concerns(in_one(clean, name, change)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: changed(e, VELOCITY, lambda x: x * 180 / np.pi), "only if arm_velocity is in deg/s"),
        (lambda e: changed(e, "arm_angle", lambda x: x * 180 / np.pi), "only if arm_angle is in degrees"),
        (lambda e: changed(e, VELOCITY, lambda x: -x), "arm_angle turns against arm_velocity"),
        (lambda e: dataclasses.replace(e, sample_time=2 * e.sample_time), "only if sample_time is twice the true one"),
        (lambda e: changed(e, VELOCITY, lambda x: np.roll(x, 5)), "arm_velocity comes 5 samples after arm_angle"),
        (lambda e: changed(e, "arm_angle", lambda x: (x + np.pi) % (2 * np.pi)), "jumps by a whole turn"),
        (lambda e: dataclasses.replace(e, initial_arm_angle=np.rad2deg(e.initial_arm_angle)), "only if it is in degrees"),
        (lambda e: dataclasses.replace(e, initial_arm_angle=e.initial_arm_angle + 1.0), "correct one of the two"),
        (lambda e: changed(e, POSITION, lambda x: 1e3 * x), "more than 10 g"),
        (lambda e: changed(e, POSITION, lambda x: x + 1.0), "so it has an offset"),
        (lambda e: dataclasses.replace(e, sample_time=1e3 * e.sample_time), "more than half a turn from one sample"),
    ],
)  # fmt: skip
def test_channels_of_one_experiment_are_held_against_each_other_without_a_fit(recordings, change, words):
    said = [sentence for sentence in concerns(in_one(recordings[1], FORCED, change)) if words in sentence]
    assert said
    assert all(sentence.startswith(f"{FORCED}: ") for sentence in said)
    assert not any(words in sentence for sentence in concerns(recordings[1]))


@pytest.mark.parametrize("samples", [5, pytest.param(8, marks=pytest.mark.slow)])
def test_a_late_current_of_a_clamped_motor_is_named_beside_its_mirror(samples):
    """Of two channels one is late as the other is early, which is one clock, and not several numbers of samples."""
    time = 0.002 * np.arange(2500)
    current = 0.08 * np.sin(9 * time) + 0.06 * np.sin(23 * time + 1)
    plans = [
        virtual_rig.Plan(
            f"run_{n}", "forced", 5.0, 0.002, current * (1 + 0.2 * n), cart="clamped", initial_angle=0.3 * n
        )
        for n in range(3)
    ]
    made = virtual_rig.record(
        virtual_rig.Rig(velocity_noise=0.005), [*plans, virtual_rig.Plan("rest", "rest", 2.0, 0.002)], seed=1
    )
    late = everywhere(made, lambda e: changed(e, "current", lambda x: np.roll(x, samples)) if e.kind == "forced" else e)
    (found,) = est.channel_consistency(late).found
    assert found.mistake == f"arm_velocity -{samples} samples"
    assert found.alike == (f"current +{samples} samples",)
    assert found.after < 1.5 < found.before


@pytest.mark.parametrize(
    ("other", "of", "named"),
    [(14, POSITION, True), (16, POSITION, False), (-12, VELOCITY, True), (-16, VELOCITY, True)],
)
def test_a_delay_that_several_numbers_of_samples_explain_is_none(other, of, named):
    """Friction that the equations lack looks like a cart that comes 13 samples early, or 16."""
    late = {m.samples: m for m in delays(POSITION, (12, 14, 16))}
    beside = next(m for m in delays(of, (abs(other),)) if m.samples == other)
    found = _likeliest([(late[12], 1.5), (beside, 1.6)], 30.0)
    assert (found is not None) == named


def test_swapped_velocity_and_angle_are_named(recordings):
    found = est.channel_consistency(in_one(recordings[1], FORCED, swapped(VELOCITY, "arm_angle")))
    assert "arm_velocity and arm_angle fit when they are swapped" in found.concerns[0]


def test_a_rest_that_moves_tells_no_noise(clean):
    """Otherwise nothing would stand out of what it takes for noise."""
    name, change, _ = MOMENTARY["rest that swings"]
    both = in_one(in_one(clean, name, change), FORCED, OF_CHANNELS["sign of velocity"][0])
    assert moving_at_rest(both) == [name]
    assert "arm_velocity fits with the sign swapped" in est.channel_consistency(both).concerns[0]


def test_the_symmetries_of_the_rig_are_offered_as_well(clean):
    """The rig and its mirror image obey the same equations, and half a turn of the arm is a position that counts backwards."""
    found = est.channel_consistency(in_one(clean, FORCED, OF_CHANNELS["sign of position"][0]))
    assert found.found[0].alike == ("initial_arm_angle off by half a turn",)

    def mirrored(e):
        for channel in (POSITION, VELOCITY, "current"):
            e = changed(e, channel, lambda x: -x)
        return dataclasses.replace(e, initial_arm_angle=-e.initial_arm_angle)

    assert est.channel_consistency(everywhere(clean, mirrored)).concerns == []


def test_an_offset_that_is_little_beside_the_motion_is_no_contradiction_on_a_stiff_spring(clean):
    """Two degrees of tilt are micrometres on a spring of 50,000 N/m; so are hysteresis and what softens one side."""
    moving = [e for e in clean if e.kind != "rest"]
    amplitude = np.sqrt(2) * max(float(np.std(e.outputs[POSITION].values)) for e in moving)
    stiff = dict.fromkeys(COEFFICIENTS, 0.0) | {"spring": 5e4}
    for fraction, told in ((0.01, False), (0.2, False), (0.3, True), (-0.3, True)):
        off = offset_of_all(stiff | {"against_offset": fraction * amplitude * 5e4}, moving)
        assert (off is not None) == told
        assert off is None or off == pytest.approx(fraction * amplitude)
    assert offset_of_all(stiff, moving) is None


@pytest.mark.parametrize(("motion", "named"), [(1.0, True), (0.1, False)])
def test_what_is_undone_leaves_no_more_of_the_motion_than_as_recorded(clean, motion, named, monkeypatch):
    """Channels that change places change their noise, too: a quarter of its deviations may be more of what moves."""
    search = _Search(everywhere(clean, OF_CHANNELS["velocity in rpm"][0]))
    recorded = solve(list(search.systems.values()))
    assert recorded.residual > 20

    def undone(mistake, names):
        if "swapped" not in mistake.id:
            return None
        return dataclasses.replace(recorded, squares=recorded.squares / 16, motion=motion * recorded.motion)

    monkeypatch.setattr(search, "_all_undone", undone)
    monkeypatch.setattr("estimators.validation.channel_consistency.EXPLAINS", 1.0)
    found = search.of_all(list(search.systems))
    assert (found is not None) == named


def test_a_rail_without_a_spring_has_no_place_where_one_is_at_rest(clean):
    change, words = OF_CHANNELS["offset of 5 mm"]
    moved = everywhere(clean, change)
    assert words in est.channel_consistency(moved).concerns[0]
    railed = dataclasses.replace(moved, rig=moved.rig | {"spring_stiffness": 0.0})
    assert not any("has an offset" in sentence for sentence in est.channel_consistency(railed).concerns)


def test_what_was_not_measured_is_not_held_against_anything(clean):
    def bare(e):
        return dataclasses.replace(e, outputs={VELOCITY: e.outputs[VELOCITY]}, initial_arm_angle=None)

    found = est.channel_consistency(everywhere(clean, bare))
    assert found.concerns == []
    assert "No experiment shows enough" in str(found)
    assert "no usual mistake explains more" in str(est.channel_consistency(clean))


def drawn_with_effects(draws, first):
    """One recording for each of so many draws of a hidden effect of the study of diagnosis, none of them among them."""
    cases = [case for case in _cases(tomllib.loads(STUDY.read_text())) if "effect" in case]
    order = np.random.default_rng(first).permutation(len(cases))[:draws]
    jobs = []
    for place, number in enumerate(order):
        rig = dataclasses.replace(virtual_rig.Rig().drawn(first + place), **cases[number].get("values", {}))
        plans = virtual_rig.standard_plans(
            seed=first + place, duration=4.0, free=2, forced=3, played=cases[number].get("played")
        )
        jobs.append((rig, plans, first + place))
    names = [f"{place}: {cases[number]['effect']}" for place, number in enumerate(order)]
    return dict(zip(names, virtual_rig.record_many(jobs, step=5e-4), strict=True))


def _cases(node):
    if isinstance(node, dict):
        yield node
        node = list(node.values())
    for child in node if isinstance(node, list) else ():
        yield from _cases(child)


def unfounded(recording):
    """What is said of a recording beside what its channels lack."""
    said = [sentence for sentence in concerns(recording) if "arm_angle was not measured" not in sentence]
    return said + est.channel_consistency(recording).concerns


def test_clean_recordings_raise_no_concern(recordings):
    plain = virtual_rig.record_many(
        [
            (virtual_rig.Rig().drawn(n), virtual_rig.standard_plans(seed=n, duration=4.0, free=2, forced=3), n)
            for n in range(20)
        ],
        step=5e-4,
    )
    assert [unfounded(recording) for recording in [*recordings, *plain]] == [[]] * 22


@pytest.mark.parametrize("draws", [6, pytest.param(43, marks=pytest.mark.slow)])
def test_missing_effects_raise_no_concern(draws):
    found = {name: unfounded(recording) for name, recording in drawn_with_effects(draws, 1000).items()}
    biased = [found.pop(name) for name in list(found) if name.endswith("tacho_bias")]
    assert all("the sensor's zero is off" in sentence for said in biased for sentence in said), "which it is"
    assert {name: said for name, said in found.items() if said} == {}


@pytest.mark.parametrize(
    "rig",
    [
        {"total_mass": 2.46},
        pytest.param({"total_mass": 1.23 * 2.2046}, marks=pytest.mark.slow),
        pytest.param({"arm_inertia": 0.5 * 9.5e-5}, marks=pytest.mark.slow),
    ],
)
def test_an_experiment_is_not_accused_where_the_others_are_no_better(rig):
    """A constant that is wrong by a factor that is no unit's."""
    plans = virtual_rig.standard_plans(seed=1, duration=4.0, free=2, forced=3)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=1)
    found = est.channel_consistency(dataclasses.replace(recording, rig=recording.rig | rig))
    assert all(one.after < one.before for one in found.found if one.experiment is not None)
    assert found.residual > 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [14, 21])
def test_a_gain_of_the_tachometer_is_no_mistake_of_one_experiment(seed):
    """Of 40 rigs these two had an experiment whose initial angle seemed to be in degrees, or of the other sign."""
    rig = dataclasses.replace(virtual_rig.Rig().drawn(900 + seed), tacho_gain=1.05)
    plans = virtual_rig.standard_plans(seed=910 + seed, duration=4.0, free=2, forced=4)
    recording = virtual_rig.record(rig, plans, seed=seed)
    found = est.channel_consistency(recording)
    assert found.residual > 3  # the equations leave something, as they should
    assert found.concerns == []
    # A mistake beside it is still named, where it makes more of a difference.
    current = {e.name: e.inputs["current"] for e in recording if "current" in e.inputs}
    swapped = dataclasses.replace(current["forced_2"], values=-current["forced_2"].values)
    wrong = tuple(
        dataclasses.replace(e, inputs=dict(e.inputs) | {"current": swapped}) if e.name == "forced_2" else e
        for e in recording
    )
    (named,) = est.channel_consistency(dataclasses.replace(recording, experiments=wrong)).found
    assert (named.experiment, named.mistake) == ("forced_2", "sign of current")


@pytest.mark.parametrize("seed", [41, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (44, 47))])
@pytest.mark.parametrize("name", ["free_2", "forced_2"])
def test_an_offset_is_named_where_the_cart_never_slides(seed, name):
    """Of such a cart the equations say nothing, but a spring does not hold it far from where it is at rest."""
    plans = virtual_rig.standard_plans(seed=seed, duration=6.0, free=2, forced=3, rest=1)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=seed + 1)
    assert est.channel_consistency(recording).concerns == []
    for offset in (5e-3, -20e-3):
        found = est.channel_consistency(in_one(recording, name, shifted(offset)))
        assert [(one.experiment, one.mistake) for one in found.found] == [(name, "offset of cart_position")]
        way, metres = re.findall(r"(subtract|add) ([0-9.]+) m (?:from|to) cart_position", found.concerns[0])[0]
        assert way == ("subtract" if offset > 0 else "add")
        assert float(metres) == pytest.approx(abs(offset), abs=2.5e-4)  # dry friction holds the cart within 0.2 mm


def shifted(offset):
    def change(experiment):
        position = experiment.outputs["cart_position"]
        moved = dataclasses.replace(position, values=position.values + offset)
        return dataclasses.replace(experiment, outputs={**experiment.outputs, "cart_position": moved})

    return change


@pytest.mark.parametrize(("times", "may"), [(1.0, False), (1000.0, True), (100.0, True), (10.0, False)])
def test_only_what_is_out_of_line_with_the_others_may_be_in_another_unit(clean, times, may):
    """Where dry friction leaves the others far from the equations, a run fits that is made to vanish beside them."""
    recording = in_one(clean, "forced_1", lambda e: changed(e, "cart_position", lambda x: times * x))
    (millimetres,) = (one for one in usual_mistakes() if one.id == "cart_position in mm")
    assert _Search(recording)._may_have("forced_1", millimetres) is may


@pytest.mark.parametrize(
    ("frequency", "told"),
    [(50.0, "Hum of the mains is in"), (60.3, "likely hum of the mains"), (43.0, "set its kind to free")],
)
def test_hum_of_the_mains_is_no_motion_at_rest(frequency, told):
    time, random = 1e-3 * np.arange(3000), np.random.default_rng(5)
    decay = 2.0 * np.exp(-0.5 * time) * np.cos(10.0 * time) + 0.01 * random.standard_normal(3000)
    resting = 0.4 * np.sin(2 * np.pi * frequency * time) + 0.01 * random.standard_normal(3000)
    recording = rtac.Recording(
        [
            rtac.Experiment.of("free_1", kind="free", sample_time=1e-3, arm_velocity=decay),
            rtac.Experiment.of("rest_1", kind="rest", sample_time=1e-3, arm_velocity=resting),
        ]
    )
    ways = ("Hum of the mains is in", "likely hum of the mains", "set its kind to free")
    said = [one for one in concerns(recording) if any(way in one for way in ways)]
    assert [way for way in ways if way in " ".join(said)] == [told]
    assert len(said) == 1


def test_angle_and_velocity_that_agree_are_not_taken_for_swapped_or_wrong(recordings) -> None:
    """A controller may make a current look like the velocity, and a pendulum's gravity, missing in the equations, does the rest."""
    e = next(one for one in recordings[1] if one.kind == "forced")
    sign = e.outputs["arm_velocity"]
    as_velocity = dataclasses.replace(e.inputs["current"], values=0.01 * sign.values)
    controlled = dataclasses.replace(e, inputs={**e.inputs, "current": as_velocity})
    by_id = {mistake.id: mistake for mistake in usual_mistakes()}
    for name in (
        "current and arm_velocity swapped", "sign of arm_velocity", "sign of arm_angle", "arm_velocity in rpm"
    ):  # fmt: skip
        undone = by_id[name].undo(controlled)
        assert undone is not None
        assert arm_kinematics.is_contradicted(controlled, undone, 0.1), name
        assert _undone(controlled, by_id[name]) is controlled  # so it explains nothing
    backwards = dataclasses.replace(
        e, outputs={**e.outputs, "arm_velocity": dataclasses.replace(sign, values=-sign.values)}
    )
    assert not arm_kinematics.is_contradicted(backwards, e, 0.1)
    alone = dataclasses.replace(e, outputs={"arm_velocity": sign})
    assert arm_kinematics.velocity_error(alone) is None


def test_a_slide_is_anywhere() -> None:
    """Half a metre from zero, and without a spring: no offset is told where the rig says that it has none."""
    time = 0.005 * np.arange(800)
    position = 0.45 + 0.01 * np.sin(3 * time) + 1e-6 * np.random.default_rng(0).standard_normal(time.size)
    run = rtac.Experiment.of(
        "run",
        kind="forced",
        sample_time=0.005,
        disturbance_force=np.cos(3 * time),
        cart_position=position,
        arm="locked",
    )
    known = {"total_mass": 6.28}
    assert any("it has an offset" in said for said in concerns(rtac.Recording((run,), known)))
    slide = rtac.Recording((run,), known | {"spring_stiffness": 0.0})
    assert not any("offset" in said for said in [*concerns(slide), *est.channel_consistency(slide).concerns])
    assert float(rtac.RTAC.from_rig(slide)["spring_stiffness"]) == 0.0


@pytest.mark.parametrize(("spring", "time", "held"), [(110.0, 4.0, True), (3.6, 1.5, False), (0.0, 100.0, False)])
def test_what_does_not_swing_twice_is_held_nowhere(spring: float, time: float, held: bool) -> None:
    """The paper's cart in four seconds, and a slide whose estimate of a stiffness is next to nothing."""
    assert is_held(spring, time) == held
