"""Starts of many fits from their first samples, held against the truth and against what the first samples showed before."""

import dataclasses

import numpy as np
import pytest

from estimators.output_error.batched_starts import with_starts_of_first_samples
from estimators.output_error.fit_case import Case
from rtac_jax import RTAC, virtual_rig

RIG = virtual_rig.Rig()


def case(seed: int, **fields: float) -> Case:
    rig = dataclasses.replace(RIG, **fields)
    plans = virtual_rig.standard_plans(seed=seed, sample_time=0.01, duration=3.0, free=2, forced=1, rest=1)
    recording = virtual_rig.record(rig, plans, seed=seed + 100)
    values = {"eccentric_moment": rig.eccentric_moment, "spring_stiffness": rig.spring_stiffness}
    return Case.of(RTAC.from_rig(recording), recording, values)


def true_starts(seed: int) -> np.ndarray:
    plans = virtual_rig.standard_plans(seed=seed, sample_time=0.01, duration=3.0, free=2, forced=1, rest=1)
    return np.array([plan.start for plan in plans if plan.kind != "rest"]).T


def starts(one: Case) -> np.ndarray:
    return one.columns.start + one.columns.start_scale * one.unknowns[len(one.names) :]


@pytest.fixture(scope="module")
def moved() -> list[tuple[Case, Case]]:
    cases = [case(seed) for seed in (1, 2, 3)]
    return list(zip(cases, with_starts_of_first_samples(cases, substeps=1), strict=True))


@pytest.mark.slow
def test_starts_come_nearer_to_the_truth(moved):
    """Positions and speeds of the cart by more than half; the truth is the virtual rig's."""
    before, after = (
        np.array(
            [np.abs(starts(pair[which]) - true_starts(seed))[:2] for seed, pair in zip((1, 2, 3), moved, strict=True)]
        )
        for which in (0, 1)
    )
    assert np.all(np.sqrt(np.mean(after**2, axis=(0, 2))) < 0.5 * np.sqrt(np.mean(before**2, axis=(0, 2))))


def test_parameters_stay_and_company_changes_no_bit(moved):
    for before, after in moved:
        count = len(before.names)
        np.testing.assert_array_equal(after.unknowns[:count], before.unknowns[:count])
        (alone,) = with_starts_of_first_samples([before], substeps=1)
        np.testing.assert_array_equal(alone.unknowns, after.unknowns)


def test_a_start_that_leads_nowhere_is_left(moved):
    lost, kept = moved[0][0], moved[1][0]
    unknowns = lost.unknowns.copy()
    unknowns[len(lost.names) :, 0] = 1e200
    found = with_starts_of_first_samples([dataclasses.replace(lost, unknowns=unknowns), kept], substeps=1)
    np.testing.assert_array_equal(found[0].unknowns[:, 0], unknowns[:, 0])
    np.testing.assert_array_equal(found[1].unknowns, moved[1][1].unknowns)
