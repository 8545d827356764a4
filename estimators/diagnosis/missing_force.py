"""The curve that explains most of what is missing, by a policy."""

from collections.abc import Sequence

from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.misspecification.adequacy import AdequacyTest, excess_of, significant
from estimators.misspecification.static_force import ForceCurve


def static_force(
    curves: Sequence[ForceCurve], tests: Sequence[AdequacyTest], policy: DiagnosisPolicy = STANDARD
) -> tuple[ForceCurve | None, bool]:
    """Return the curve that explains most of what is missing, if one does; and whether any explains more than chance."""
    rejecting = next((test for test in tests if test.test == "static force" and test.rejects), None)
    if rejecting is None:
        return None, False
    best = max(significant(curves, rejecting.level), key=lambda c: c.excess, default=None)
    if best is None or not best.excess > policy.static * excess_of(tests):
        return None, True
    return best, True
