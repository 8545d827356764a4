"""Hum of the mains: found where it is, nowhere else, and taken out whole."""

import dataclasses
import functools

import numpy as np
import pytest

import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.measurement import Experiment, Signal, _hum, concerns

INTERVAL, SIZE = 0.002, 4e-5


@functools.cache
def clean(**options: float) -> rtac.Recording:
    """Return free and forced experiments of a rig without hum."""
    plans = virtual_rig.standard_plans(seed=3, duration=4.0, sample_time=INTERVAL, free=1, forced=3, rest=1)
    return virtual_rig.record(virtual_rig.Rig(**options), plans, seed=3, step=5e-4)


def with_hum(recording: rtac.Recording, hertz: float, size: float = SIZE) -> rtac.Recording:
    """Return the recording with a sine in the position, of a phase of its own in each experiment."""

    def hummed(e: Experiment, number: int) -> Experiment:
        wave = size * np.cos(2 * np.pi * hertz * np.arange(e.samples) * e.sample_time + number)
        signal = e.outputs["cart_position"]
        return dataclasses.replace(
            e, outputs=dict(e.outputs) | {"cart_position": dataclasses.replace(signal, values=signal.values + wave)}
        )

    return dataclasses.replace(recording, experiments=tuple(hummed(e, n) for n, e in enumerate(recording)))


@pytest.mark.parametrize("hertz", [49.93, 60.05, 99.98, 120.03])
def test_hum_is_measured_and_taken_out_to_a_fraction_of_the_noise(hertz: float) -> None:
    recording = clean()
    hummed = with_hum(recording, hertz)
    (hum,) = hummed.hum()
    assert (hum.channel, hum.unit) == ("cart_position", "m")
    assert hum.frequency == pytest.approx(hertz, abs=0.03)
    assert hum.amplitude == pytest.approx(SIZE, rel=0.1)
    mended = hummed.without_hum()
    assert not mended.hum()
    noise = np.std(recording["rest_1"].outputs["cart_position"].values)
    for experiment in recording:
        left, there = (
            r[experiment.name].outputs["cart_position"].values - experiment.outputs["cart_position"].values
            for r in (mended, hummed)
        )
        assert np.std(there) > noise
        assert np.std(left) < 0.15 * noise
        for other in set(experiment.outputs) - {"cart_position"}:
            assert np.array_equal(mended[experiment.name].outputs[other].values, experiment.outputs[other].values)


def test_where_there_is_none_the_recording_is_the_same() -> None:
    for recording in (clean(), clean(cogging_torque=2e-3), with_hum(clean(), 43.0)):
        assert recording.hum() == ()
        assert recording.without_hum() is recording


def test_hum_that_wanders_is_followed_part_by_part() -> None:
    time = INTERVAL * np.arange(20_000)
    noise = 1e-6 * np.random.default_rng(5).standard_normal(len(time))
    wave = SIZE * np.cos(2 * np.pi * (50.0 * time + 0.001 * time**2))  # by 0.08 Hz in 40 s
    e = Experiment("long", "rest", INTERVAL, {}, {"cart_position": Signal(noise + wave, "m")})
    (mended,) = rtac.Recording((e,)).without_hum()
    assert np.std(mended.outputs["cart_position"].values - noise) < 0.1 * np.std(wave)


def test_harmonics_of_an_input_that_repeats_are_no_hum() -> None:
    # Every half hertz one line, as a nonlinearity answers to a period of two seconds.
    random, time = np.random.default_rng(8), INTERVAL * np.arange(4000)
    comb = sum(np.cos(2 * np.pi * 0.5 * k * time + random.uniform(0, 7)) for k in range(1, 400))
    values = 1e-6 * comb + 1e-7 * random.standard_normal(len(time))
    several = tuple(
        Experiment(f"e{n}", "free", INTERVAL, {}, {"cart_position": Signal(np.roll(values, 37 * n), "m")})
        for n in range(4)
    )
    assert rtac.Recording(several).hum() == ()


def test_chance_makes_no_hum() -> None:
    random = np.random.default_rng(11)
    for _ in range(200):
        noise = [np.cumsum(random.standard_normal(1200)) * 1e-6 for _ in range(3)]
        several = tuple(
            Experiment(f"e{n}", "rest", INTERVAL, {}, {"cart_position": Signal(x, "m")}) for n, x in enumerate(noise)
        )
        assert rtac.Recording(several).hum() == ()


@pytest.mark.parametrize("hertz", [48.5, 49.5, 50.5, 60.5])
def test_a_line_beside_the_mains_is_none_of_theirs(hertz: float) -> None:
    assert with_hum(clean(), hertz).hum() == ()


def driven_by(values: np.ndarray) -> rtac.Recording:
    """Return a decay, a run with this current and a record at rest, of a rig with dry friction in its drive and fine sensors."""
    plans = virtual_rig.standard_plans(seed=3, duration=4.0, sample_time=INTERVAL, free=1, forced=1, rest=1)
    given = [dataclasses.replace(p, current=values) if p.kind == "forced" else p for p in plans]
    return virtual_rig.record(
        virtual_rig.Rig(arm_coulomb=4e-3, position_noise=1e-6, quantisation_bits=16), given, seed=3, step=5e-4
    )


TIME = INTERVAL * np.arange(2000)
RANDOM = np.random.default_rng(4)


@pytest.mark.parametrize(
    ("values", "alone"),
    [
        (0.5 * np.sin(100 * np.pi * TIME), True),
        (0.1 * np.sum([np.cos(2 * np.pi * f * TIME + f**2) for f in range(2, 71, 2)], axis=0), False),
        (0.5 * np.repeat(RANDOM.choice([-1.0, 1.0], 500), 4), False),
        (0.5 * RANDOM.standard_normal(2000), False),
        (0.1 * np.sin(20 * np.pi * TIME), False),
        (0.1 * np.sign(np.sin(2 * np.pi * TIME)), False),
    ],
    ids=["the same frequency", "multisine", "binary", "white", "a fifth part", "square"],
)
def test_what_the_rig_answers_to_the_current_is_not_taken_for_hum(values: np.ndarray, alone: bool) -> None:
    """Where it is larger than the hum the line stays as it is; where it is small the hum beside it is subtracted."""
    recording = driven_by(values)
    hummed = with_hum(recording, 50.0, 2e-6)
    assert hummed.hum()
    there, here, true = (
        r["forced_1"].outputs["cart_position"].values for r in (hummed, hummed.without_hum(), recording)
    )
    assert np.array_equal(here, there) == alone
    assert alone or np.std(here - true) < 0.3 * np.std(there - true)


@pytest.mark.parametrize(
    "values", [np.full(2000, 0.1), 0.1 * np.sin(20 * np.pi * TIME)], ids=["constant", "a fifth part"]
)
@pytest.mark.parametrize(("times", "alone"), [(2.0, True), (0.5, True), (1.1, False)])
def test_a_line_that_the_input_may_have_made_is_hum_where_it_is_as_large(
    values: np.ndarray, times: float, alone: bool
) -> None:
    """A constant current turns a motor whose torque ripples; dry friction makes harmonics."""
    recording = clean()
    larger = {e.name: e for e in with_hum(recording, 50.0, times * SIZE)}
    driven = dataclasses.replace(
        larger["forced_2"],
        inputs={"current": dataclasses.replace(recording["forced_2"].inputs["current"], values=values)},
    )
    mixed = dataclasses.replace(
        recording, experiments=tuple(driven if e.name == "forced_2" else e for e in with_hum(recording, 50.0))
    )
    here, there = (r["forced_2"].outputs["cart_position"].values for r in (mixed.without_hum(), mixed))
    assert np.array_equal(here, there) == alone


def test_nothing_is_hum_that_only_driven_experiments_show() -> None:
    hummed = with_hum(clean(), 50.0)
    assert hummed.select(["free_1", "forced_1"]).hum()
    assert hummed.select(["forced_1", "forced_2", "forced_3"]).hum() == ()
    # Whose fifth harmonic is a line, by the dry friction.
    assert driven_by(0.1 * np.sin(20 * np.pi * TIME)).hum() == ()


def test_samples_that_are_missing_do_not_count() -> None:
    hummed = with_hum(clean(), 50.0)
    gap = slice(900, 1300)

    def torn(e: Experiment) -> Experiment:
        values = np.array(e.outputs["cart_position"].values)
        values[gap] = np.nan
        return dataclasses.replace(
            e,
            outputs=dict(e.outputs) | {"cart_position": dataclasses.replace(e.outputs["cart_position"], values=values)},
        )

    mended = dataclasses.replace(hummed, experiments=tuple(map(torn, hummed))).without_hum()
    for experiment in clean():
        there = mended[experiment.name].outputs["cart_position"].values
        left = np.delete(there - experiment.outputs["cart_position"].values, gap)
        assert np.std(left) < 0.15 * SIZE
        assert np.isnan(there[gap]).all()


def test_an_experiment_without_it_keeps_its_numbers() -> None:
    hummed, quiet = with_hum(clean(), 50.0), clean()
    mixed = dataclasses.replace(hummed, experiments=tuple(quiet[e.name] if e.name == "free_1" else e for e in hummed))
    (hum,) = mixed.hum()
    assert hum.amplitude == pytest.approx(SIZE, rel=0.05)
    assert np.array_equal(
        mixed.without_hum()["free_1"].outputs["cart_position"].values, quiet["free_1"].outputs["cart_position"].values
    )


def at_rest(name: str, seconds: float, seed: int, size: float = SIZE) -> Experiment:
    time = INTERVAL * np.arange(round(seconds / INTERVAL))
    noise = 1e-6 * np.random.default_rng(seed).standard_normal(len(time))
    return Experiment(
        name, "rest", INTERVAL, {}, {"cart_position": Signal(noise + size * np.cos(100 * np.pi * time), "m")}
    )


@pytest.mark.parametrize(
    "several", [[at_rest(f"e{n}", 3.0, n) for n in range(30)], [at_rest("long", 300.0, 1)]], ids=["30", "300 s"]
)
def test_many_experiments_and_long_ones_are_told_together(several: list[Experiment]) -> None:
    (hum,) = rtac.Recording(tuple(several)).hum()
    assert hum.amplitude == pytest.approx(SIZE, rel=0.01)


def test_what_no_experiment_shows_by_itself_is_not_subtracted(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = with_hum(clean(), 50.0)
    original = _hum._beyond_chance
    monkeypatch.setattr(_hum, "_beyond_chance", lambda lines, level: level < 0.01 and original(lines, level))
    assert recording.without_hum() is recording


def test_of_many_experiments_those_without_it_keep_their_numbers() -> None:
    several = (at_rest("hum", 3.0, 100), *(at_rest(f"e{n}", 3.0, n, size=0.0) for n in range(60)))
    recording = rtac.Recording(several)
    kept = [
        e.outputs["cart_position"].values is recording[e.name].outputs["cart_position"].values
        for e in recording.without_hum()
    ]
    assert kept == [False, *[True] * 60]


@pytest.mark.parametrize(("seconds", "parts"), [(10.0, 1), (4.0, 1), (4.0, 4)])
@pytest.mark.parametrize("level", [0.05, 0.01])
@pytest.mark.slow
def test_noise_is_beyond_chance_as_seldom_as_said(seconds: float, parts: int, level: float) -> None:
    """Of 1,500 draws; seldomer where a line must also be larger than any beside it."""
    random, count = np.random.default_rng(7), round(seconds / INTERVAL)
    whole = slice(0, count)

    def drawn() -> list[_hum._Line]:
        found = [_hum._largest(random.standard_normal(count), whole, INTERVAL, 50.0) for _ in range(parts)]
        return [line for line in found if line is not None]

    fraction = np.mean([_hum._beyond_chance(drawn(), level) for _ in range(1500)])
    assert fraction <= level + 2.5 * np.sqrt(level / 1500)
    assert parts > 1 or fraction > 0.2 * level


def test_slow_motion_in_short_records_is_no_hum() -> None:
    time = 2e-5 * np.arange(3000)
    moving = tuple(
        Experiment(
            f"e{n}",
            "free",
            2e-5,
            {},
            {
                "cart_position": Signal(
                    1e-3 * np.cos(90 * time + n) + 1e-7 * np.random.default_rng(n).standard_normal(3000), "m"
                )
            },
        )
        for n in range(3)
    )
    assert rtac.Recording(moving).hum() == ()


def test_short_or_slow_experiments_tell_nothing_of_it() -> None:
    short = tuple(e.cut(0, 200) for e in with_hum(clean(), 50.0))
    assert rtac.Recording(short).hum() == ()
    slow = virtual_rig.standard_plans(seed=3, duration=8.0, sample_time=0.01, free=1, forced=1, rest=0)
    assert with_hum(virtual_rig.record(virtual_rig.Rig(), slow, seed=3), 50.0).hum() == ()


def test_it_is_a_concern_that_says_who_takes_it_out() -> None:
    (said,) = [one for one in concerns(with_hum(clean(), 50.0)) if one.startswith("Hum of the mains")]
    assert "cart_position 4e-05 m at 50 Hz" in said
    assert "recording.without_hum()" in said
