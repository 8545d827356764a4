"""Frequency responses of operating conditions, as records that python-control can take."""

from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
import scipy.stats
from jaxtyping import Complex128, Float64

from estimators.core.drawing import draw
from estimators.core.result_base import Result
from rtac_jax.overview import Overview

Curve = Float64[np.ndarray, " frequency"]
_SHOWN = 6  # names in a sentence


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """The response of one condition; all arrays have one entry for each frequency.

    Attributes:
        name: of the condition.
        frequency: [rad/s].
        response: from x = input * cos(theta) where `compensated`, else from the input, in units of output / input.
        std: root of the mean squared magnitude of the response's error, by noise and distortion together.
        noise_std: the same by noise alone; equal to `std` where the method cannot tell them apart.
        freedom: complex degrees of freedom of `std`.
        odd_distortion, even_distortion: root mean square of what nonlinearities of odd and even order add at a line, in
            units of the response; None where no harmonic was left out to show it.
        coherence: fraction of the output's power that follows the input [1].
        input_rms: [unit of the input].
        arm_angle: mean over the experiment, or at its start [rad]; None where nothing tells.
        compensated: whether cos(theta) is part of the input.
        feedback: fraction of what is new in the output that the input answers [1], as a controller in the loop makes it; zero
            where that may be chance.
    """

    name: str
    frequency: Curve
    response: Complex128[np.ndarray, " frequency"]
    std: Curve
    noise_std: Curve
    freedom: int
    odd_distortion: Curve | None
    even_distortion: Curve | None
    coherence: Curve
    input_rms: float
    arm_angle: float | None
    compensated: bool
    input: str = "current"
    output: str = "cart_position"
    feedback: float = 0.0

    def frd(self) -> ct.FrequencyResponseData:
        """Return the response as python-control's `FRD`."""
        return ct.frd(self.response, self.frequency, name=self.name)

    def radius(self, confidence: float = 0.95) -> Curve:
        """Return the radius of the disc about the response that holds the truth with this probability, at each frequency.

        The error is circular complex, so its squared magnitude over the estimated variance has the F distribution with 2
        and 2 `freedom` degrees.
        """
        return self.std * np.sqrt(scipy.stats.f.ppf(confidence, 2, 2 * self.freedom))

    def actual(self, angle: float | None = None) -> Complex128[np.ndarray, " frequency"]:
        """Return the response from the input itself at an arm angle [rad]: cos(theta_0) is put back (paper, Fig. 3).

        Args:
            angle: by default that of the condition.

        Raises:
            ValueError: the angle is neither given nor known.
        """
        if not self.compensated:
            return self.response
        at = self.arm_angle if angle is None else angle
        if at is None:
            raise ValueError(f"{self.name}: the arm's angle is not known; give angle.")
        return self.response * np.cos(at)


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyResponses(Result):
    """The responses of all conditions, in order; iteration and `[name or number]` give one of them."""

    conditions: tuple[FrequencyResponse, ...]

    def __iter__(self) -> Any:
        return iter(self.conditions)

    def __len__(self) -> int:
        return len(self.conditions)

    def __getitem__(self, which: int | str) -> FrequencyResponse:
        if isinstance(which, int):
            return self.conditions[which]
        for one in self.conditions:
            if one.name == which:
                return one
        raise KeyError(f"no condition {which!r}; there are {', '.join(one.name for one in self.conditions)}")

    @property
    def frequency(self) -> Curve:
        """Return the common grid [rad/s].

        Raises:
            ValueError: the conditions have different grids.
        """
        grid = self.conditions[0].frequency
        for one in self.conditions:
            if len(one.frequency) != len(grid) or not np.allclose(one.frequency, grid, rtol=1e-9):
                raise ValueError(
                    f"{one.name} has other frequencies than {self.conditions[0].name}; give frequency_responses one grid by "
                    "its argument frequency, or where the lengths are equal by band."
                )
        return grid

    @property
    def response(self) -> Complex128[np.ndarray, "condition frequency"]:
        """Return all responses on the common grid."""
        _ = self.frequency
        return np.stack([one.response for one in self.conditions])

    @property
    def std(self) -> Float64[np.ndarray, "condition frequency"]:
        """Return all standard deviations on the common grid."""
        _ = self.frequency
        return np.stack([one.std for one in self.conditions])

    def require(self, into: str, out: str) -> None:
        """Refuse responses of other channels, or without the compensation of Fig. 3.

        Raises:
            ValueError: names the first such condition.
        """
        for one in self:
            if (one.input, one.output, one.compensated) != (into, out, True):
                raise ValueError(
                    f"responses: {one.name} is from {one.input}{' times cos(theta)' if one.compensated else ''} to {one.output}; "
                    f"give those from {into} times cos(theta) to {out}."
                )

    def remarks(self) -> list[str]:
        """Return what no standard deviation counts: conditions whose input follows the noise of the output."""
        fed_back = {one.name: one.feedback for one in self if one.feedback > 0}
        if not fed_back:
            return []
        others = f" and {len(fed_back) - _SHOWN} more" if len(fed_back) > _SHOWN else ""
        named = f"{', '.join(list(fed_back)[:_SHOWN])}{others}"
        return [
            f"The input answers the noise of the output, as with a controller in the loop ({named}; up to "
            f"{100 * max(fed_back.values()):.0f} % of what is new in the output): where noise makes much of the input a response "
            "tends to that of the controller, inverted, which no standard deviation counts. Play the input open loop, or take the "
            "responses of linear models with a model of the noise, which allow feedback: est.prediction_error(..., "
            'structure="box_jenkins").'
        ]

    def frd(self) -> list[ct.FrequencyResponseData]:
        """Return the responses as python-control's `FRD`, one for each condition."""
        return [one.frd() for one in self.conditions]

    def overview(self) -> Overview:
        """Return band, input and uncertainty of every condition."""
        rows = [
            (
                one.name,
                f"{one.frequency[0]:.3g} to {one.frequency[-1]:.3g}",
                f"{one.input_rms:.3g}",
                f"{100 * float(np.median(one.std / np.abs(one.response))):.2f}",
            )
            for one in self.conditions
        ]
        header = ("condition", "band [rad/s]", "input rms", "std [%]")
        return Overview(f"frequency responses of {len(self)} conditions", header, rows)

    def __str__(self) -> str:
        head = f"{'condition':16s} {'lines':>5s} {'band [rad/s]':>16s} {'input rms':>10s} {'angle [rad]':>11s} {'std [%]':>8s}"
        rows = [head]
        for one in self.conditions:
            band = f"{one.frequency[0]:.3g} to {one.frequency[-1]:.3g}"
            angle = "" if one.arm_angle is None else f"{one.arm_angle:.2f}"
            fraction = 100 * float(np.median(one.std / np.abs(one.response)))
            rows.append(
                f"{one.name:16s} {len(one.frequency):5d} {band:>16s} {one.input_rms:10.3g} {angle:>11s} {fraction:8.2f}"
            )
        return "\n".join([*rows, *self.remarks()])

    def plot(self) -> Any:
        """Draw magnitude and phase of all conditions, with their uncertainty."""
        return draw(self)
