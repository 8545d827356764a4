"""What became of each candidate, in the table of a diagnosis."""

import dataclasses

import made_up_results
import pytest

from estimators.reporting.tables import candidate_table


@pytest.mark.parametrize(
    ("added", "fates"),
    [
        (None, ["accepted", "", ""]),
        (["b"], ["not kept", "added later", ""]),
        (["a", "b"], ["accepted", "added later", ""]),
    ],
)
def test_what_a_loop_kept_is_told_apart_from_what_the_diagnosis_named(
    added: list[str] | None, fates: list[str]
) -> None:
    several = tuple(made_up_results.candidate(name, 50.0) for name in ("a", "b", "c"))
    found = dataclasses.replace(made_up_results.diagnosis("missing"), effects=several[:1], candidates=several)
    rows = {row[0]: row[-1] for row in candidate_table(found, added).rows}
    assert [rows[name] for name in ("a", "b", "c")] == fates


def test_what_the_data_could_not_show_stands_below_the_table() -> None:
    shown, hidden, nearest = (made_up_results.candidate(name, -5.0) for name in ("shown", "hidden", "nearest"))
    hidden = dataclasses.replace(hidden, testable=False)
    nearest = dataclasses.replace(nearest, testable=False, refitted=True)
    found = dataclasses.replace(made_up_results.diagnosis("unknown"), effects=(), candidates=(shown, hidden, nearest))
    table = candidate_table(found)
    assert [row[0] for row in table.rows] == ["shown", "nearest"]
    assert str(table).splitlines()[-1] == "Not testable with these data beside the model that was diagnosed: hidden."
    assert not candidate_table(dataclasses.replace(found, candidates=(shown,))).note


def test_what_reaches_an_alarm_is_no_candidate_that_the_data_could_not_show() -> None:
    """Beside "arm_coulomb reaches 232, the alarm is at 20" it stood among what was not testable."""
    small, large = (
        dataclasses.replace(made_up_results.candidate(n, s), testable=False) for n, s in (("a", -5.0), ("b", 50.0))
    )
    found = dataclasses.replace(made_up_results.diagnosis("adequate"), effects=(), candidates=(small, large))
    table = candidate_table(found)
    assert [(row[0], row[-2]) for row in table.rows] == [("b", "large, not confirmed")]
    assert str(table).splitlines()[-1] == "Not testable with these data beside the model that was diagnosed: a."
