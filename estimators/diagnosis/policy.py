"""The thresholds by which a diagnosis chooses and judges refits: each with its meaning and its source."""

import dataclasses
from typing import Any

from estimators.inference.simulation_residual import SimulationLimits
from estimators.misspecification.findings import CriticalValues
from estimators.prediction_error.colour_limits import ColourLimits

VERSION = 16
"""Of the standard policy: counts up when a threshold comes, goes or changes."""

_PROTOTYPE = "prototype study of 42 cases a setting"
_ABLATION = "ablation of 379 recordings (docs/method.md)"
_UNSTUDIED = "set when the rule was added; never studied by itself"
_FRACTIONS = (
    "removed", "static", "close", "chance", "level", "known", "consequence", "edge", "colour_little", "unfollowed",
)  # fmt: skip


def _threshold(default: float | int, meaning: str, source: str) -> Any:
    """Declare a threshold: its value, what it decides, and where the value comes from."""
    return dataclasses.field(default=default, metadata={"meaning": meaning, "source": source})


# Deviations from nothing below which an effect may as well not be there, as in the usual interval of 95 %: without it the data are
# then fitted too.
SURE = 2.0


@dataclasses.dataclass(frozen=True)
class DiagnosisPolicy:
    """The thresholds by which a diagnosis calls effects found, models adequate and rivals not to be told apart.

    It holds every threshold that can change a verdict; what merely defines a statistic, as the length of a stretch of data, stands
    beside that. `judge`, the choice among refits, the steps of a selection and the colour of the noise read it. A policy of one's
    own is passed to `est.diagnose`, stands in its result and in the JSON, and any other can judge the same evidence again.

    Raises:
        ValueError: a threshold is negative, or a fraction is above one.
    """

    removed: float = _threshold(
        0.9,
        "fraction of the misfit that the named effects must remove; the rest is the size, two standard deviations added, under"
        " which what an effect presupposes is ruled out beside it, and the noise's part of a simulation's rms error under which"
        " that is far from the data, so that, beside random forces, effects are selected by simulation too; and of the rms error"
        " that random forces would leave, under which they cannot act",
        f"{_PROTOTYPE}: it refused three effects outside the catalogue",
    )
    static: float = _threshold(
        0.5,
        "fraction of the misfit that a static force must explain to be called the missing force, and of the squared error of a"
        " simulation an effect to be selected by it",
        _UNSTUDIED,
    )
    bic_gain: float = _threshold(
        10.0,
        "gain in BIC that a candidate, or coloured noise without a rest record, must reach; within it a candidate cannot be told"
        " from the best, and rest records do not speak against a colour",
        "Kass and Raftery, JASA 90 (1995): very strong evidence",
    )
    refits: int = _threshold(
        4, "candidates refitted at least, and at most in the place of the first of several effects", _PROTOTYPE
    )
    close: float = _threshold(
        0.3,
        "fraction of the best score within which a candidate is refitted too, and of the first effect's gain in BIC within which"
        " one may replace it",
        _PROTOTYPE,
    )
    edge: float = _threshold(
        0.1,
        "times the noise of the sensor that would show it, below which a shape is at its edge, and the law the simpler one that it"
        " contains",
        "bristles of a seventieth of a count were named where dry friction is larger one way; never studied by itself",
    )
    consequence: float = _threshold(
        0.01,
        "fraction of the error, predicted or simulated, that named effects must take off to be of consequence, and of the rms force"
        " or torque that random ones must have in one sample: where a fit follows nothing, or is far from the data, a simulation"
        " says then whether what is named is right",
        "with enough data every model is wrong. Of random forces: right names left 1e-5, what stood in for others 0.1 to 0.8",
    )
    effects: int = _threshold(
        3,
        "effects that one diagnosis names at most",
        f"{_ABLATION}: one at most would change 82 verdicts, 81 for the worse",
    )
    alarm: float = _threshold(20.0, "chi-square from which a candidate's score rejects its absence", _PROTOTYPE)
    chance: float = _threshold(
        2e-3,
        "probability of an alarm by chance: by any candidate, by the scatter over seconds of data; by the noise of a rest record,"
        " that it is not white; by a simulation's error, that it is more than random forces leave",
        f"{_ABLATION}: without it 32 verdicts change, 25 for the worse",
    )
    level: float = _threshold(
        0.01,
        "probability that any test rejects a right model",
        "convention; recordings with nothing hidden of draws 44 to 94: 313 of 314 adequate",
    )
    known: float = _threshold(
        0.02,
        "fraction of what all experiments know of an effect that the others must know to predict the one held out",
        f"{_ABLATION}: without it 3 verdicts change, 2 for the worse",
    )
    testable: float = _threshold(
        30.0,
        "detection limit over the plausible size from which the data cannot show an effect, and none is named",
        _UNSTUDIED,
    )
    colour_little: float = _threshold(
        ColourLimits.little,
        "fraction of coloured noise that is left out of account",
        _UNSTUDIED,
    )
    fall: float = _threshold(
        0.05,
        "fraction by which an effect must lower the held-out error of simulation to be kept by `est.improve`",
        _UNSTUDIED,
    )
    near_noise: float = _threshold(
        1.5,
        "held-out error of simulation over the noise below which any fall is enough for that",
        _UNSTUDIED,
    )
    ahead_level: float = _threshold(
        0.05,
        "probability that an effect is kept for its predictions one sample ahead by chance",
        "convention",
    )
    simulation_noise: float = _threshold(
        SimulationLimits.beyond,
        "squared simulation error over the squared noise from which the model misses more than the sensors do",
        "both are equally large at 2",
    )
    simulation_poor: float = _threshold(
        SimulationLimits.poor,
        "rms simulation error over the rms of the motion from which a simulation is poor",
        "a fit of 90 % as in Ljung, System Identification (1999), section 16.5",
    )
    random_large: float = _threshold(
        SimulationLimits.large,
        "random forces, averaged over a radian of the cart's swing, over the rms forces, that are no small disturbance; in one"
        " sample, from which it is asked what they hide, as parts that hit each other",
        "set between shaken rigs (0.005 to 0.01) and recordings with signs or units wrong (0.1 to 0.4)",
    )
    unfollowed: float = _threshold(
        SimulationLimits.unfollowed,
        "rms simulation error of the fit over the rms of the motion from which it follows nothing, so that effects are screened by"
        " the equations of motion too",
        "moderate effects of the study 0.20 at most in 56 of 58 recordings (draws 201 and 202), gross ones 0.31 to 0.94",
    )

    confirming: int = _threshold(
        3,
        "experiments at least that an effect, estimated from the others, makes likelier by `bic_gain` in twice the log-likelihood,"
        " and none less likely by as much, to be named where nothing rejects",
        "two draws of six of Stribeck friction beside bristles gained 22 to 290 so in each; never studied by itself",
    )

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) >= 0:
                raise ValueError(
                    f"DiagnosisPolicy.{field.name} is {getattr(self, field.name)}; give a number that is not negative."
                )
        for name in (*_FRACTIONS, "fall", "ahead_level"):
            if getattr(self, name) > 1:
                raise ValueError(f"DiagnosisPolicy.{name} is {getattr(self, name)}; it is a fraction, at most 1.")
        for name in ("refits", "effects", "confirming"):
            if getattr(self, name) < 1:
                raise ValueError(f"DiagnosisPolicy.{name} is {getattr(self, name)}; give 1 or more.")

    @property
    def critical(self) -> CriticalValues:
        """Return the thresholds of the tests of adequacy."""
        return CriticalValues(self.alarm, self.chance, self.level)

    @property
    def left(self) -> float:
        """Return the fraction that may be left of what is ruled out."""
        return 1.0 - self.removed

    @property
    def far(self) -> float:
        """Return the rms simulation error over the noise from which the noise is no more of it than may be `left`."""
        return 1.0 / self.left if self.left else float("inf")

    @property
    def colour(self) -> ColourLimits:
        """Return the thresholds of noise at rest."""
        return ColourLimits(self.chance, self.colour_little)

    @property
    def simulation(self) -> SimulationLimits:
        """Return the thresholds of the simulation's error."""
        return SimulationLimits(
            self.simulation_noise,
            self.simulation_poor,
            self.random_large,
            self.chance,
            self.unfollowed,
            self.left,
            self.consequence,
        )

    @property
    def words(self) -> str:
        """Say in one sentence by which thresholds was judged: the standard ones, or which of them differ."""
        changed = [
            f"{name} = {value:g} (standard {getattr(STANDARD, name):g})"
            for name, value in self.as_dict().items()
            if value != getattr(STANDARD, name)
        ]
        own = f"the standard policy but for {', '.join(changed)}" if changed else "the standard policy"
        return f"Judged by {own} (version {VERSION}, {len(self.as_dict())} thresholds)."

    def as_dict(self) -> dict[str, float | int]:
        """Return every threshold by its name."""
        return dataclasses.asdict(self)

    def rows(self) -> list[tuple[str, float | int, str, str]]:
        """Return every threshold with its value, meaning and source."""
        return [
            (field.name, getattr(self, field.name), field.metadata["meaning"], field.metadata["source"])
            for field in dataclasses.fields(self)
        ]

    def __str__(self) -> str:
        return "\n".join(
            f"{name:16s} {value:>8g}  {meaning} ({source})" for name, value, meaning, source in self.rows()
        )


STANDARD = DiagnosisPolicy()
