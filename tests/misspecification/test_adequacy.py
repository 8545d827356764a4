"""The tests behind a diagnosis on data made by plain NumPy: how often they cry wolf, and whether they see what is there."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.core.data import Data
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.misspecification.adequacy import AdequacyTest, adequacy_tests, overshadowing, suspects
from estimators.misspecification.findings import CriticalValues, Findings, Score, SpectralLine, StaticForce
from estimators.misspecification.line_classes import line_classes, period
from estimators.misspecification.replication_test import repeat_test
from estimators.misspecification.residual_maps import where
from estimators.misspecification.score_test import score_test
from estimators.misspecification.spectral_line_test import spectral_line
from estimators.prediction_error.innovations import stretches
from estimators.validation.model_comparison import held_out, vuong
from rtac_jax.measurement import Experiment

SAMPLES, COUNT = 1000, 4
CRITICAL = CriticalValues(20.0, 2e-3, 0.01)


def experiments(*, repeats: bool = False, current: np.ndarray | None = None) -> list[Experiment]:
    """Records whose only use here is their shape."""
    return [
        Experiment.of(
            f"forced_{n}",
            kind="forced",
            sample_time=0.01,
            current=np.sin(0.3 * np.arange(SAMPLES)) if current is None else current,
            cart_position=np.cos(0.1 * np.arange(SAMPLES) + n),
            repeat_of="forced_0" if repeats and n else None,
        )
        for n in range(COUNT)
    ]


def noise(random: np.random.Generator, colour: float, count: int = COUNT) -> np.ndarray:
    """Noise of unit variance, [sample output experiment], first-order coloured; only the first output is measured."""
    white = random.normal(size=(SAMPLES + 200, count))
    found = np.zeros((SAMPLES, 3, count))
    found[:, 0] = lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], white, axis=0)[200:]
    return found


PRESENT = np.zeros((SAMPLES, 3, COUNT))
PRESENT[:, 0] = 1.0


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_repeats_of_noise_alone_seldom_reject(colour: float) -> None:
    random = np.random.default_rng(1)
    p = []
    for _ in range(400):
        found = repeat_test(noise(random, colour), PRESENT, experiments(repeats=True))
        assert found is not None
        p.append(found.p_value)
    assert 0.0 < np.mean(np.array(p) < 0.05) < 0.09
    assert np.mean(np.array(p) < 0.01) < 0.03


def test_what_repeats_share_is_found() -> None:
    random = np.random.default_rng(2)
    error = noise(random, 0.9)
    error[:, 0] += 0.6 * np.sin(0.05 * np.arange(SAMPLES))[:, None]
    found = repeat_test(error, PRESENT, experiments(repeats=True))
    assert found is not None
    assert found.p_value < 1e-3
    assert found.ratio > 1.3
    # A moving average of five samples takes little of it.
    assert 0.7 < found.power / (COUNT * np.mean((0.6 * np.sin(0.05 * np.arange(SAMPLES))) ** 2)) < 1.3
    assert found.repeats == COUNT
    assert found.part == 1.0
    assert repeat_test(error, PRESENT, experiments()) is None


@pytest.mark.parametrize("repeated", [2, COUNT])
@pytest.mark.parametrize("shape", ["slow", "fast", "broad"])
def test_what_repeats_share_is_as_large_as_the_squares_that_it_adds(repeated: int, shape: str) -> None:
    """Of all data, whatever part of them is repeated, and however fast it changes."""
    time, random = np.arange(SAMPLES), np.random.default_rng(2)
    missing = {
        "slow": 0.6 * np.sin(0.05 * time),
        "fast": 0.6 * np.sin(2.5 * time),
        "broad": 0.5 * random.standard_normal(SAMPLES),
    }[shape]
    several = [
        dataclasses.replace(e, repeat_of=None if n >= repeated else e.repeat_of)
        for n, e in enumerate(experiments(repeats=True))
    ]
    shares = []
    for _ in range(20):
        error = noise(random, 0.0)
        error[:, 0] += missing[:, None]
        found = repeat_test(error, PRESENT, several)
        assert found is not None
        assert found.part == repeated / COUNT
        shares.append(found.excess / (COUNT * np.sum(missing**2)))
    assert np.mean(shares) == pytest.approx(1.0, abs=0.15)


def test_repeats_that_share_nothing_leave_no_excess_of_less_than_nothing() -> None:
    random = np.random.default_rng(4)
    found = [repeat_test(noise(random, 0.0), PRESENT, experiments(repeats=True)) for _ in range(20)]
    shared = np.array([one.shared for one in found if one is not None])
    assert len(shared) == 20
    assert shared.min() < 0 < shared.max()
    assert all(one is not None and one.excess == max(one.shared, 0.0) for one in found)


def test_repeats_that_agree_to_the_last_digit_are_no_repeats() -> None:
    once = np.random.default_rng(5).standard_normal((SAMPLES, PRESENT.shape[1], 1))
    assert repeat_test(np.tile(once, (1, 1, COUNT)), PRESENT, experiments(repeats=True)) is None


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_score_test_keeps_its_level(colour: float) -> None:
    """Also with coloured noise, of which the model knows nothing."""
    random = np.random.default_rng(3)
    time = np.arange(SAMPLES * COUNT)
    columns = np.stack([np.sin(0.02 * k * time + 0.3 * k) for k in range(1, 9)], axis=1)
    basis = np.linalg.qr(np.stack([np.ones(len(time)), time - 2000.0], axis=1))[0]
    blocks = time // 100
    p = []
    for _ in range(400):
        error = noise(random, colour)[:, 0].T.ravel()
        p.append(score_test(columns, error - basis @ (basis.T @ error), basis, blocks).p_value)
    assert np.mean(np.array(p) < 0.01) < 0.03
    if colour == 0.0:
        assert np.mean(np.array(p) < 0.2) > 0.08  # it does reject


def of_lengths(*seconds: float) -> Data:
    """What counts of experiments of these lengths at 50 Hz, one output measured."""
    parts = [np.cos(0.1 * np.arange(round(50 * s))) for s in seconds]
    return Data.of(
        [
            Experiment.of(f"forced_{n}", kind="forced", sample_time=0.02, current=x, cart_position=x)
            for n, x in enumerate(parts)
        ]
    )


def test_stretches_are_of_what_counts() -> None:
    data = of_lengths(2.0, 5.3, 0.4)
    gap = dataclasses.replace(data, trusted=data.trusted.at[106:159, 1].set(0.0))
    for one, expected in ((data, 2 + 5 + 1), (gap, 2 + 4 + 1)):
        counts = np.asarray(one.counted).any(axis=1)
        numbers = stretches(one)
        assert np.array_equal(np.unique(numbers), np.arange(expected))
        assert np.array_equal(np.unique(numbers[counts]), np.arange(expected))
        assert np.all(np.diff(numbers.T.ravel()) >= 0)
    lengths = np.bincount(stretches(data)[np.asarray(data.counted).any(axis=1)])
    assert np.array_equal(lengths, [50, 50, 53, 53, 53, 53, 53, 20])


@pytest.mark.parametrize(
    "seconds",
    [(2.0,) * 5 + (20.0,), (2.0,) * 6],
    ids=["beside one that is much longer", "fewer stretches than columns"],
)
def test_score_test_keeps_its_level_in_short_experiments(seconds: tuple[float, ...]) -> None:
    """What is beyond the end of a short experiment is no time in which noise was quiet."""
    random = np.random.default_rng(8)
    data = of_lengths(*seconds)
    there = np.asarray(data.counted).any(axis=1).T.ravel()
    blocks = stretches(data).T.ravel()
    time = np.arange(there.size)
    columns = np.stack([np.sin(0.05 * k * time + 0.3 * k) for k in range(1, 13)], axis=1) * there[:, None]
    basis = np.linalg.qr(np.stack([there, time * there], axis=1).astype(float))[0]

    def p_value(colour: float, force: float) -> float:
        white = random.normal(size=there.size + 200)
        error = lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], white)[200:] * there + force * columns[:, 2]
        return score_test(columns, error - basis @ (basis.T @ error), basis, blocks).p_value

    assert np.mean([p_value(0.9, 0.0) < 0.01 for _ in range(250)]) < 0.03
    assert np.mean([p_value(0.0, 0.8) < 1e-3 for _ in range(50)]) > 0.8  # a force a little below the noise is seen


def test_a_column_that_the_data_do_not_show_has_no_standard_deviation() -> None:
    random = np.random.default_rng(9)
    columns = random.normal(size=(SAMPLES, 3)) * [1.0, 1e-5, 0.0]
    found = score_test(columns, random.normal(size=SAMPLES), np.zeros((SAMPLES, 0)), np.arange(SAMPLES) // 50)
    assert found.freedom == 1
    assert np.array_equal(np.isfinite(found.std), [True, False, False])


def test_of_the_forces_that_explain_more_than_chance_the_largest_says_how_much() -> None:
    """Not the surest: what is named must remove nine tenths of it."""

    def force(p_value: float, excess: float) -> StaticForce:
        return StaticForce("cart", "cart_position", p_value, excess)

    (found,) = adequacy_tests(Findings(curves=(force(1e-14, 60.0), force(1e-9, 400.0), force(0.3, 900.0))), CRITICAL)
    assert found.rejects
    assert found.excess == 400.0
    (chance,) = adequacy_tests(Findings(curves=(force(0.2, 60.0), force(0.3, 900.0))), CRITICAL)
    assert not chance.rejects


def test_score_test_estimates_what_is_there() -> None:
    random = np.random.default_rng(4)
    columns = random.normal(size=(SAMPLES, 3))
    basis = np.linalg.qr(random.normal(size=(SAMPLES, 2)))[0]
    inside = []
    for _ in range(300):
        truth = random.normal(size=3)
        error = random.normal(size=SAMPLES) - columns @ truth
        found = score_test(columns, error - basis @ (basis.T @ error), basis, np.arange(SAMPLES) // 20)
        assert np.sum(found.by_direction) == pytest.approx(found.explained)
        assert np.all(np.diff(found.by_direction) <= 0), "most telling first"
        inside.append(np.abs(found.coefficients - truth) < 1.96 * found.std)
    assert 0.92 < np.mean(inside) < 0.98
    assert found.freedom == 3
    again = score_test(basis, np.ones(SAMPLES), basis, np.zeros(SAMPLES, int))
    assert again.freedom == 0  # what the basis explains already is nothing new
    assert again.p_value == 1.0


@pytest.mark.parametrize(
    ("gaps", "colour", "count"),
    [
        pytest.param(*case, marks=[pytest.mark.slow] * (case not in {(0, 0.0, COUNT), (0, 0.9, 1), (8, 0.9, 2)}))
        for case in itertools.product((0, 8), (0.0, 0.9), (1, 2, COUNT))
    ],
)
def test_noise_alone_seldom_has_a_line(colour: float, count: int, gaps: int) -> None:
    """Also of one experiment, where the noise around a line is hardly known, and with samples that do not count."""
    random = np.random.default_rng(5)
    p = []
    for _ in range(1000):
        present = PRESENT[:, :, :count].copy()
        for begin in random.integers(0, SAMPLES - 50, gaps):
            present[begin : begin + 50] = 0.0
        found = spectral_line(noise(random, colour, count), present, experiments()[:count])
        assert found is not None
        p.append(found.p_value)
    # Of 1000 at that level 20 come by chance in one of a thousand cases, and 8 of those at the level of a diagnosis.
    assert np.sum(np.array(p) < 0.01) <= 20
    assert np.sum(np.array(p) < 0.002) <= 8
    assert np.mean(np.array(p) < 0.2) > 0.02  # it does reject


def test_a_vibration_is_found_at_its_frequency() -> None:
    random = np.random.default_rng(6)
    error = noise(random, 0.9)
    for n in range(COUNT):  # of a phase of its own in every experiment
        error[:, 0, n] += 0.3 * np.sin(44.0 * 0.01 * np.arange(SAMPLES) + n)
    found = spectral_line(error, PRESENT, experiments())
    assert found is not None
    assert found.p_value < 1e-6
    assert found.frequency == pytest.approx(44.0, abs=2 * np.pi / 10.0)
    assert found.channel == "cart_position"


@pytest.mark.parametrize(
    ("hertz", "said"),
    [(50.1, "50.1 Hz, that of the mains"), (100.0, "100 Hz, twice that of the mains"), (44.0, "44 Hz")],
)
def test_a_line_is_told_in_hertz_with_a_word_where_it_is_that_of_the_mains(hertz: float, said: str) -> None:
    line = SpectralLine("cart_position", 2 * np.pi * hertz, 40.0, 80.0, 1e-9)
    (test,) = adequacy_tests(Findings(line=line), CRITICAL)
    assert test.rejects
    assert suspects([one("a", 30.0, 0.5)], [test], CRITICAL)
    assert f"rad/s ({said}), has 40.0 times the power around it" in test.words


def periodic(odd_only: bool = True) -> np.ndarray:
    random = np.random.default_rng(7)
    time = np.arange(SAMPLES) / 250.0
    lines = np.arange(1, 12, 2) if odd_only else np.arange(1, 12)
    return sum(np.cos(2 * np.pi * k * time + random.uniform(0, 2 * np.pi)) for k in lines if k != 5)


def test_line_classes_tell_odd_from_even() -> None:
    random = np.random.default_rng(8)
    drive = periodic()
    assert period(drive) == 250
    assert period(random.normal(size=100)) is None
    assert period(np.zeros(100)) is None
    for power, shows in ((3, "odd"), (2, "even"), (1, "excited")):
        error = noise(random, 0.0)
        error[:, 0] += 0.2 * (drive**power)[:, None]
        classes = {c.lines: c for c in line_classes(error, PRESENT, experiments(current=drive))}
        assert classes[shows].p_value < 1e-6
        others = {"odd", "even"} - {shows}
        if power != 1:
            assert classes[others.pop()].p_value > 1e-3
    quiet = line_classes(noise(random, 0.0), PRESENT, experiments(current=drive))
    assert all(c.p_value > 1e-3 for c in quiet)
    assert line_classes(noise(random, 0.0), PRESENT, experiments(current=random.normal(size=SAMPLES))) == []


def test_bounds_of_the_places_hold() -> None:
    random = np.random.default_rng(9)
    above = [np.mean([p.value > p.high for p in where(noise(random, 0.0), PRESENT, experiments())]) for _ in range(200)]
    assert 0.001 < np.mean(above) < 0.02
    error = noise(random, 0.0)
    error[:, :, 2] *= 1.5
    found = where(error, PRESENT, experiments())
    worst = found[0]
    for kind, first in (("time", "quarter {} of each experiment"), ("frequency", None), ("cart_position", None)):
        parts = sorted({(p.part, p.label) for p in found if p.by == kind})
        assert [part for part, _ in parts] == [0, 1, 2, 3], "one label for each part"
        # The upper edge of a part is the lower one of the next.
        words = [label.removesuffix(" rad/s").split("| ")[-1].split(" to ") for _, label in parts]
        if first is None:
            assert [high for _, high in words[:-1]] == [low for low, _ in words[1:]]
        else:
            assert [label for _, label in parts] == [first.format(n) for n in range(1, 5)]
    assert worst.label == "forced_2"
    assert worst.value == pytest.approx(2.25, rel=0.2)
    fast = where(error, PRESENT, [dataclasses.replace(e, sample_time=1e-3) for e in experiments()])
    assert "1050 to 3140 rad/s" in {place.label for place in fast}


def test_held_out_score_is_that_of_fits_without_each_experiment() -> None:
    """For a linear model the step is exact, so it must equal real refits."""
    random = np.random.default_rng(10)
    matrices = random.normal(size=(5, 40, 3))
    outputs = matrices @ np.array([1.0, -2.0, 0.5]) + random.normal(size=(5, 40))
    whole = np.linalg.lstsq(matrices.reshape(-1, 3), outputs.ravel(), rcond=None)[0]
    rests = outputs - matrices @ whole
    factors = np.stack([np.linalg.qr(np.column_stack([-m, r]), mode="r") for m, r in zip(matrices, rests, strict=True)])
    found = float(np.sum(-0.5 * np.sum(rests**2, axis=1) + held_out(factors, 3, range(3))[0]))
    expected = 0.0
    for e in range(5):
        others = [i for i in range(5) if i != e]
        fitted = np.linalg.lstsq(matrices[others].reshape(-1, 3), outputs[others].ravel(), rcond=None)[0]
        expected -= 0.5 * np.sum((outputs[e] - matrices[e] @ fitted) ** 2)
    assert found == pytest.approx(expected, rel=1e-9)
    only = np.where(np.arange(5)[:, None, None] == 2, factors, factors * np.array([1.0, 1.0, 0.0, 1.0]))
    alone, known = held_out(only, 3, [2])  # one experiment alone tells of the third
    assert known[2] < DiagnosisPolicy().known < np.min(np.delete(known, 2))
    assert np.isfinite(np.delete(alone, 2)).all()
    scaled = np.linalg.qr(factors * np.array([1.0, 1e17, 1e-12, 1.0]), mode="r")  # by what unknowns are not worth
    for here, there in zip(held_out(scaled, 3, [2]), held_out(factors, 3, [2]), strict=True):
        assert here == pytest.approx(there, rel=1e-6)
    nothing = np.linalg.qr(factors[2:3] * np.array([1.0, 1e17, 0.0, 1.0]), mode="r")
    assert held_out(nothing, 3, [2])[1] == pytest.approx(0.0, abs=1e-9)  # SVD had not converged here
    alone, known = held_out(factors[2:3], 3, [2])
    assert np.isnan(alone).all()  # without any other experiment there is no gain
    assert known == pytest.approx(0.0, abs=1e-9)


def test_vuong_of_equal_models_is_standard_normal() -> None:
    random = np.random.default_rng(11)
    blocks = np.arange(2000).reshape(-1, 1) // 20
    z = [vuong(random.normal(size=(2000, 1)), random.normal(size=(2000, 1)), blocks, 0.0) for _ in range(400)]
    assert np.std(z) == pytest.approx(1.0, abs=0.12)
    assert abs(np.mean(z)) < 0.2
    assert vuong(np.full((2000, 1), 0.1), random.normal(size=(2000, 1)), blocks, 0.0) > 2.0


def one(name: str, statistic: float, p_value: float) -> Score:
    return Score(name, 0, (), statistic, p_value)


def test_where_only_another_test_rejects_every_large_candidate_is_refitted() -> None:
    def said(p_value: float) -> list[AdequacyTest]:
        return [AdequacyTest("static force", p_value, 400.0, 0.002, "")]

    # A stop that is hit once is large by the model's variance, and no more than its scatter over seconds.
    stop, spring, small = one("end_stop", 461.0, 0.05), one("cubic_spring", 356.0, 1e-9), one("cogging", 9.0, 0.3)
    assert suspects([stop, small], said(1e-40), CRITICAL) == [stop]
    assert suspects([stop, small], said(0.5), CRITICAL) == []
    assert suspects([stop, spring, small], said(1e-40), CRITICAL) == []


def test_what_is_larger_than_all_that_alarms_is_not_passed_over_for_it() -> None:
    ripple, gain, mode = (
        one("lvdt_ripple", 2957.0, 0.02),
        one("lvdt_gain", 1676.0, 1e-15),
        one("flexible_mode", 900.0, 0.1),
    )
    other_shape = one("lvdt_gain", 3000.0, 0.02)
    assert overshadowing([ripple, mode, gain, other_shape], CRITICAL) == [ripple]
    assert overshadowing([ripple, mode], CRITICAL) == []


def test_a_large_candidate_that_raises_no_alarm_keeps_its_own_p_value() -> None:
    """Beside an alarm of 20, "127 passes, p = 1" would be no number that anybody can use."""
    (scattering,) = adequacy_tests(Findings((one("arm_coulomb", 127.0, 4e-3), one("cogging", 3.0, 0.1))), CRITICAL)
    assert scattering.p_value == pytest.approx(8e-3)  # of any of the two
    assert "arm_coulomb reaches 127, the alarm is at 20, but it scatters" in scattering.words
    assert "p = 0.004" in scattering.words
    assert scattering.p_value < scattering.level
    assert not scattering.rejects  # for lack of an alarm, not of a small p-value
    (alarming,) = adequacy_tests(Findings((one("arm_coulomb", 127.0, 1e-9), one("cogging", 3.0, 0.1))), CRITICAL)
    assert alarming.rejects
    assert alarming.words == "arm_coulomb reaches 127, the alarm is at 20"
    (small,) = adequacy_tests(Findings((one("arm_coulomb", 19.0, 1e-5),)), CRITICAL)
    assert small.p_value == 1e-5
    assert not small.rejects
