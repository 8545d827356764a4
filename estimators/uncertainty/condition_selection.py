"""Selection of the experiments that show a frequency response, all on one grid."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from estimators.frequency_response.estimate import DrownedError, check_shown, condition_responses
from estimators.frequency_response.response import FrequencyResponse, FrequencyResponses
from estimators.linear.fit import LinearModels, prediction_error
from rtac_jax.measurement import Experiment, Recording

# rms of cos(theta), below which a fifth of the motor's push at most reaches the cart: 14 dB less, of a response whose noise stays.
LEAST_GRIP = 0.2
_INPUT, _OUTPUT = "current", "cart_position"
_EDGES = (0.002, 0.998)  # of an input's energy, between which its band lies
_MOST_LINES = 300  # of the grid: more make the envelope no closer
_WINDOW = 0.5  # Hz, half of what the local fit spans where the record is long enough for so few lines
_LEAST, _MOST = 12, 40  # lines to each side of that fit


@dataclass(frozen=True, eq=False)
class UsableConditions:
    """The responses from current times cos(theta) [A] to cart position [m].

    Attributes:
        responses: of the conditions that could be used.
        left_out: why each other forced experiment could not.
        integrated: those of them whose angle was not measured but integrated from the arm's velocity.
        grips: rms of cos(theta) of every forced experiment whose angle was measured: the fraction of the motor's push that reaches
            the cart.
        models: that the responses are of, by the prediction error method, and those left out as hardly known; None where
            they are by local polynomials.
    """

    responses: FrequencyResponses
    left_out: dict[str, str]
    models: LinearModels | None = None
    integrated: tuple[str, ...] = ()
    grips: Mapping[str, float] = field(default_factory=dict)

    @property
    def without_grip(self) -> tuple[str, ...]:
        """Return the names of the experiments, used or not, whose arm stood near 90 degrees."""
        return tuple(name for name, grip in self.grips.items() if grip < LEAST_GRIP)


def usable_conditions(
    recording: Recording, *, band: tuple[float, float] | None = None, modes: int | None = None, progress: bool = False
) -> UsableConditions:
    """Return the frequency responses of all usable conditions on one grid.

    Every forced experiment with a current and a cart position is a condition, unless it repeats another.

    Args:
        recording: with forced experiments.
        band: [Hz]; by default where all currents have energy.
        modes: of linear models fitted by the prediction error method, whose responses are taken; by default there are no
            models, and the responses are by local polynomials.
        progress: show a bar.

    Raises:
        ValueError: fewer than two conditions, a band in which they have no common lines, or as `prediction_error`.
    """
    kept, left_out = [], {}
    for e in recording:
        if e.kind == "forced":
            reason = _unfit(e)
            if reason:
                left_out[e.name] = reason
            else:
                kept.append(e)
    if len(kept) < 2:
        raise ValueError(_too_few([e.name for e in kept], left_out))
    grid = _grid(kept, band)
    rests = [e.name for e in recording if e.kind == "rest"]  # they tell the tachometer's bias
    widths = {e.name: int(np.clip(round(_WINDOW * e.duration), _LEAST, _MOST)) for e in kept}
    found, shown = [], []
    for name, one in condition_responses(recording, list(widths), frequency=grid, half_width=widths).items():
        if isinstance(one, FrequencyResponse):
            found.append(one)
            shown.append(name)
        elif modes is None or isinstance(one, DrownedError):
            left_out[name] = str(one)
        else:  # what a local fit lacks, a model may not
            shown.append(name)
    if len(shown) < 2:
        raise ValueError(_too_few(shown, left_out))
    integrated = tuple(name for name in shown if "arm_angle" not in recording[name].outputs)
    grips = {
        e.name: float(np.sqrt(np.nanmean(np.cos(e.outputs["arm_angle"].values) ** 2)))
        for e in kept
        if "arm_angle" in e.outputs
    }
    if modes is None:
        return UsableConditions(FrequencyResponses(tuple(found)), left_out, None, integrated, grips)
    models = prediction_error(recording.select([*shown, *rests]), modes=modes, progress=progress)
    known = []
    for one in models.responses(grid):
        try:
            check_shown(one)
            known.append(one)
        except DrownedError as error:
            left_out[one.name] = str(error)
    if len(known) < 2:
        raise ValueError(_too_few([one.name for one in known], left_out))
    integrated = tuple(one.name for one in known if one.name in integrated)
    return UsableConditions(FrequencyResponses(tuple(known)), left_out, models, integrated, grips)


def _unfit(experiment: Experiment) -> str:
    """Return why an experiment shows no response from the current to the cart; empty where it does."""
    if experiment.repeat_of is not None:
        return f"repeats {experiment.repeat_of}, so it is no further condition"
    if _INPUT not in experiment.inputs or not np.any(experiment.inputs[_INPUT].values):
        return "has no current"
    if _OUTPUT not in experiment.outputs or experiment.cart == "clamped":
        return "shows no motion of the cart"
    return "its arm is locked, so the current moves nothing" if experiment.arm == "locked" else ""


def _too_few(names: list[str], left_out: dict[str, str]) -> str:
    # Where one reason holds for all it is told once.
    said = {re.sub(f"/experiments/{re.escape(name)}(/\\S+)?: ", "", why).rstrip(".") for name, why in left_out.items()}
    if len(left_out) > 1 and len(said) == 1:
        reasons = f" {', '.join(left_out)}: {said.pop()};"
    else:
        reasons = "".join(f" {name}: {why.rstrip('.')};" for name, why in left_out.items())
    what = f"only {names[0]} shows" if names else "no experiment shows"
    return (
        f"{what} a frequency response from current to cart position, and an envelope needs two conditions;{reasons} record "
        "forced experiments that start at various angles."
    )


def _grid(experiments: list[Experiment], band: tuple[float, float] | None) -> np.ndarray:
    """Return common frequencies [rad/s], as far apart as the lines of the shortest record or further."""
    if band is None:
        edges = np.array([_band(e) for e in experiments])
        low, high = float(edges[:, 0].max()), float(edges[:, 1].min())
    else:
        low, high = band
    step = 1.0 / min(e.duration for e in experiments)
    highest = min(0.5 / e.sample_time for e in experiments)
    numbers = np.arange(np.ceil(low / step - 1e-9), np.floor(min(high, 0.98 * highest) / step + 1e-9) + 1)
    numbers = numbers[numbers > 0]
    if len(numbers) < 10:
        raise ValueError(
            f"between {low:.3g} and {high:.3g} Hz the conditions have {len(numbers)} lines in common, and ten are needed; "
            "give a --band that has them, or record for longer or with currents that have one band."
        )
    if len(numbers) > _MOST_LINES:
        wanted = np.geomspace(numbers[0], numbers[-1], _MOST_LINES)
        numbers = np.unique(np.rint(wanted))
    return 2 * np.pi * step * numbers


def _band(experiment: Experiment) -> tuple[float, float]:
    """Return the band in which the current has its energy [Hz]."""
    power = np.abs(np.fft.rfft(experiment.inputs[_INPUT].values)[1:]) ** 2
    fraction = np.cumsum(power) / np.sum(power)
    low, high = (1 + int(np.searchsorted(fraction, edge)) for edge in _EDGES)
    return low / experiment.duration, high / experiment.duration
