"""Output error of the repetitions of a chunk side by side, where the study begins its fits at the truth."""

from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from estimators.core.initial_rest import may_swing
from estimators.core.results import RESULTS
from estimators.output_error.batched_fit import End, fit_cases
from estimators.output_error.batched_starts import with_starts_of_first_samples
from estimators.output_error.batched_step_size import substeps_of
from estimators.output_error.fit_case import Case
from estimators.study.outcome import Outcome, Prepared, Value
from estimators.study.spec import Estimate
from rtac_jax.programs.collection import collected_later

_TOLERANCE = 0.01
"""Distance to the minimum to which a fit comes, as far as its steps tell, in standard deviations. It comes nearer: 250 fits of
six decays ended 0.0006 from it (rms; at most 0.005), which adds less than a millionth to the variance of an estimate."""
_STEPS = 60  # as `output_error` has it
_TAKEN = ("steps", "from_model", "starts")  # the second start is not looked at where fits begin at the model


def suits(estimate: Estimate, start: str) -> bool:
    """Return whether the fits of a study can be made side by side, which the study alone decides.

    They descend from the truth by simulation; a fit that begins elsewhere is led by predictions, one after the other.
    """
    options = estimate.options
    return (
        estimate.method == "output_error"
        and start == "truth"
        and set(options) <= set(_TAKEN)
        and bool(options.get("from_model", True))
    )


@collected_later()
def fit_together(chunk: Sequence[Prepared], options: Mapping[str, Any]) -> list[Outcome | None]:
    """Fit the recordings of a chunk, each with a status of its own, which no other of the chunk changes.

    None where a fit of its own has to decide: where a recording cannot be prepared, an effect has states whose beginning
    has to be looked for, the simulation diverges at the truth, data leave parameters free, one goes to its bound, or the descent is
    stuck.
    """
    found: list[Outcome | None] = [None] * len(chunk)
    groups: dict[Hashable, dict[int, Case]] = defaultdict(dict)
    for number, prepared in enumerate(chunk):
        if may_swing(prepared.model):
            continue
        try:
            case = Case.of(prepared.model, prepared.recording)
        except (ValueError, ArithmeticError):
            continue
        groups[case.kind][number] = case
    for cases in groups.values():
        by_substeps: dict[int, dict[int, Case]] = defaultdict(dict)
        for (number, case), substeps in zip(cases.items(), substeps_of(list(cases.values())), strict=True):
            by_substeps[substeps][number] = case
        for substeps, some in by_substeps.items():
            begun = with_starts_of_first_samples(list(some.values()), substeps=substeps)
            ends = fit_cases(begun, substeps=substeps, steps=options.get("steps", _STEPS), tolerance=_TOLERANCE)
            for (number, case), end in zip(some.items(), ends, strict=True):
                found[number] = _outcome(case, end)
    return found


def _outcome(case: Case, end: End) -> Outcome | None:
    if end.information is None or end.at_bound or end.result in (RESULTS.undetermined, RESULTS.stuck):
        return None
    std = np.sqrt(np.diag(end.information.covariance))
    verdict = "successful" if end.result == RESULTS.successful else "steps_exhausted"
    values = {name: Value(float(v), float(s)) for name, v, s in zip(case.shared, end.values, std, strict=True)}
    return Outcome(values, {"residual": float(np.max(end.residual / case.noise[:, 0]))}, verdict)
