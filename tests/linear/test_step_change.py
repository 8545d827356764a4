"""How a quantity that differs between conditions is told."""

import numpy as np
import pytest

from estimators.linear.homogeneity_test import Equality, trend_of
from estimators.linear.step_change import step_in_words, values_in_words

NAMES = ("e1", "e2", "e3", "e4", "e5", "e6")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((212.4, 212.5, 212.3, 206.0, 206.1, 206.0), "changes once, from 212.4 up to e3 to 206 from e4 on"),
        ((212.4, np.nan, 212.4, 206.0, np.nan, 206.0), "changes once, from 212.4 up to e3 to 206 from e4 on"),
        ((212.4, 206.0, 212.3, 206.1, 206.0, 212.5), "scatters, with nothing that was looked at: 212.4 in e1, 206 in e2"),
        # One alone is no step.
        ((212.4, 206.0, 206.1, 206.0, 206.1, 206.0), "scatters, with nothing that was looked at: 212.4 in e1"),
        ((np.nan, np.nan, np.nan, np.nan, np.nan, 1.0), ""),
    ],
)  # fmt: skip
def test_a_step_is_told_from_scatter(values: tuple[float, ...], said: str) -> None:
    given = NAMES, np.array(values), np.full(6, 0.1)
    told = step_in_words(*given) or values_in_words(*given)
    assert told.startswith(said)
    assert bool(told) == bool(said)


def test_values_along_a_line_are_no_step() -> None:
    for count in (4, 6, 20):
        assert step_in_words([f"e{n}" for n in range(count)], np.arange(float(count)), np.full(count, 0.1)) == ""


@pytest.mark.parametrize(("count", "most"), [(4, 0.03), (5, 0.015), (6, 0.005), (8, 0.001)])
def test_scatter_is_seldom_taken_for_a_step(count: int, most: float) -> None:
    random = np.random.default_rng(0)
    names, std = [f"e{n}" for n in range(count)], np.full(count, 1e-3)
    told = [bool(step_in_words(names, random.standard_normal(count), std)) for _ in range(4000)]
    assert np.mean(told) <= most


def test_of_many_values_the_ends_are_told() -> None:
    names = [f"run_{n}" for n in range(12)]
    values = 200.0 + 5.0 * np.sin(2.0 * np.arange(12.0))
    told = values_in_words(names, values, np.full(12, 0.1))
    assert (
        told == "scatters, from 195 in run_11 to 205 in run_4, with nothing that was looked at"
        or "scatters, from" in told
    )
    assert f"in run_{np.argmin(values)} to" in told


@pytest.mark.parametrize(("covariate", "said"), [("time", "changes once, from 212 up to e5"), ("input", "drifts with")])
def test_a_step_half_way_is_no_drift_with_time(covariate: str, said: str) -> None:
    """Of twelve experiments time explains three quarters of it, far beyond chance; what goes with the motion is told as before."""
    each = np.repeat([212.0, 206.0], 6) + 0.01 * np.arange(12)
    std, order = np.full((12, 1), 0.1), np.arange(12.0)
    trend = trend_of(covariate, order, each, np.diag(std[:, 0] ** -2.0))
    assert trend.p_value < 1e-3
    found = Equality(
        names=("spring_stiffness",), units=("N/m",), conditions=tuple(f"e{n}" for n in range(12)), values=each[:, None], std=std,
        common=np.array([209.0]), common_std=np.array([0.03]), chi_square=1e4, freedom=11, p_value=0.0, p_values=np.zeros(1),
        trends=((trend,),), covariates={covariate: order}, left_out=(), level=0.01, varying=("spring_stiffness",), explained=1.0,
        suffices=True,
    )  # fmt: skip
    assert f"Spring_stiffness {said}" in found.verdict
