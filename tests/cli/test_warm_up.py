"""`rtac warm-up`: what it compiles, recordings of other sizes run."""

import jax
from command_line import call, refused

from estimators.core import jacobian_factor
from estimators.prediction_error import filter_pass, innovations

PROGRAMS = (
    jacobian_factor._factors,
    jacobian_factor._residual,
    filter_pass._filter,
    innovations._innovations,
    innovations._derivatives,
)


def _compiled() -> list[int]:
    return [program.compiled for program in PROGRAMS]


def test_other_sizes_find_what_was_compiled() -> None:
    for program in PROGRAMS:
        program.forget()  # what other tests compiled
    first = call("warm-up", "--experiments", "4", "--samples", "800", "--hidden", "")
    assert first.exit_code == 0, first.output
    assert f"{jax.config.jax_compilation_cache_dir} holds" in first.stdout  # pyright: ignore[reportAttributeAccessIssue] - made when JAX starts
    row = next(line for line in first.stdout.splitlines() if "nothing" in line)
    assert row.split()[:3] == ["4", "800", "nothing"]
    assert "adequate" in row
    before = _compiled()
    assert min(before) > 0
    again = call("warm-up", "--experiments", "3", "--samples", "700", "--hidden", "")
    assert again.exit_code == 0, again.output
    assert _compiled() == before


def test_what_is_no_size_and_no_effect_is_refused() -> None:
    refused(call("warm-up", "--samples", "3"), 2, "--samples is '3'", "200 or more")
    refused(call("warm-up", "--experiments", "2.5"), 2, "--experiments is '2.5'", "whole numbers")
    refused(call("warm-up", "--hidden", "nonsense"), 2, "--hidden names nonsense", "cubic_spring")
