"""The order in which tables and pictures show candidates."""

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis


def ranked(diagnosis: Diagnosis) -> list[Candidate]:
    """Return the accepted candidates, then all others by their score."""
    place = {c.id: number for number, c in enumerate(diagnosis.effects)}
    return sorted(diagnosis.candidates, key=lambda c: (place.get(c.id, len(place)), -c.score))
