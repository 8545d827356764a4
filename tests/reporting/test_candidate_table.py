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
