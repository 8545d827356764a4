"""The thresholds by which a diagnosis chooses and judges refits: each with its meaning and its source."""

import dataclasses
from typing import Any

_PROTOTYPE = "prototype study of 42 cases a setting"
_UNSTUDIED = "set when the rule was added; never studied by itself"


def _threshold(default: float | int, meaning: str, source: str) -> Any:
    """Declare a threshold: its value, what it decides, and where the value comes from."""
    return dataclasses.field(default=default, metadata={"meaning": meaning, "source": source})


@dataclasses.dataclass(frozen=True)
class DiagnosisPolicy:
    """What a diagnosis calls found, adequate and not to be told apart.

    `judge`, the choice among refits and the steps of a selection read it. The alarm of a candidate and the levels of the tests are
    constants of `estimators.misspecification`, those of the simulation's error of `estimators.inference.simulation_residual`, and
    change a verdict too. A policy of one's own is passed to `est.diagnose`, and stands in its result and in the JSON.

    Raises:
        ValueError: a threshold is negative, or a fraction is above one.
    """

    removed: float = _threshold(
        0.9,
        "fraction of the misfit that the named effects must remove",
        f"{_PROTOTYPE}: it refused three effects outside the catalogue",
    )
    static: float = _threshold(
        0.5,
        "fraction of the misfit that a static force must explain to be called the missing force",
        _UNSTUDIED,
    )
    bic_gain: float = _threshold(
        10.0,
        "gain in BIC that a candidate must reach, and within which it cannot be told from the best",
        "Kass and Raftery, JASA 90 (1995): very strong evidence",
    )
    vuong: float = _threshold(
        1.645,
        "standard normal statistic below which two models cannot be told apart",
        "Vuong, Econometrica 57 (1989), 5 %",
    )
    nested_level: float = _threshold(
        0.01,
        "probability of so large a gain by the parameters that a larger law has more than the one it contains",
        _UNSTUDIED,
    )
    rival: float = _threshold(0.5, "fraction of the best gain that a rival must reach", _UNSTUDIED)
    reconsidered: int = _threshold(
        4,
        "candidates of a step that are held against its effect again",
        _UNSTUDIED,
    )
    refits: int = _threshold(4, "candidates refitted at least", _PROTOTYPE)
    close: float = _threshold(
        0.3,
        "fraction of the best score within which a candidate is refitted too",
        _PROTOTYPE,
    )
    hidden: int = _threshold(
        3,
        "candidates of each order refitted where random forces may hide what is missing",
        _UNSTUDIED,
    )
    line_left: float = _threshold(
        0.02,
        "fraction of the gain of an effect without an alarm that may be left in a spectral line",
        "a mode that followed a vibration of the floor left 9 %, a backlash 0.4 %",
    )
    effects: int = _threshold(3, "effects that one diagnosis names at most", _UNSTUDIED)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) >= 0:
                raise ValueError(
                    f"DiagnosisPolicy.{field.name} is {getattr(self, field.name)}; give a number that is not negative."
                )
        for name in ("removed", "static", "nested_level", "rival", "close", "line_left"):
            if getattr(self, name) > 1:
                raise ValueError(f"DiagnosisPolicy.{name} is {getattr(self, name)}; it is a fraction, at most 1.")
        for name in ("refits", "effects", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"DiagnosisPolicy.{name} is {getattr(self, name)}; give 1 or more.")

    def as_dict(self) -> dict[str, float]:
        """Return every threshold by its name."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        rows = [
            f"{field.name:14s} {getattr(self, field.name):>8g}  {field.metadata['meaning']} ({field.metadata['source']})"
            for field in dataclasses.fields(self)
        ]
        return "\n".join(rows)


STANDARD = DiagnosisPolicy()
