"""The outcome of a controller design: what it achieves and what is not guaranteed, also in sentences."""

from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from jaxtyping import Bool

from estimators.core.drawing import draw
from estimators.core.fit import FAR
from estimators.core.result_base import Result
from estimators.uncertainty.attribution import SOURCE_WORDS, SOURCES
from estimators.uncertainty.envelope import Envelope
from rtac_jax.control import Actuation, ClosedLoop, Margins, Reduction, Synthesis, Units, Weights
from rtac_jax.overview import Overview
from rtac_jax.renamed import renamed

_ANYWAY = 0.9  # fraction of plants that hold without a controller, above which a batch says little of it
_USEFUL = 0.8  # fraction of the settling time, above which a controller is of little use
_USED = 0.8  # of the torque that it may use, above which a controller uses it
_ROOM = 0.3  # of the largest |W T|, below which it is not the envelope that holds a controller back
_NARROWER = {
    "unmodelled": "an order of the nominal model or a band that suit the conditions better (--order, --band)",
    "amplitude": "conditions whose amplitudes differ less, as dry friction damps small motions more than large ones",
    "scatter": "conditions that differ less, such as arms that start and stay closer to where they push most",
    "estimation": "longer records, or currents that are larger around the resonance",
}


OFF = 0.15  # by which every parameter of a plant is off at most, where no covariance says more


@dataclass(frozen=True, eq=False, repr=False)
class ControlDesign(Result):
    """A controller for an envelope, and its loop with the fitted nonlinear model; the result of `control`.

    Attributes:
        covered: the envelope with the electric spring in the loop, from the controller's current [A] to the cart [m].
        units, actuation: of the controller, and how its output becomes torque.
        weights, synthesis, reduction: of the mixed sensitivity problem, in the controller's units.
        margins: of the sampled loop.
        controller: of lower order, continuous, from cart position [m] to torque before the division by cos(theta) [N m].
        sampled: the same for the recording's sample time; u = -C y for both.
        displacement: at the start [m].
        within: in which a plant has to settle [s].
        free, closed: the fitted model without and with the controller, and with the noise of the recording's sensors.
        off, drawn: batches of 2,000 plants, with every parameter up to 15 % off, and drawn from the covariance of the fit.
        inside: a batch of plants of the envelope, as `plants_inside` draws them; None where it holds none that the model can be.
        doubt: the largest standard deviation of any parameter that the fit tells from nothing, as a fraction of it [1].
        nothing: parameters that the fit does not tell from nothing.
        farthest: largest residual of the fit over its noise [1].
        off_free, inside_free: the plants of these batches without a controller.
        printed_bound: the least gamma that the weights printed in the paper allow, and where [rad/s].
    """

    covered: Envelope
    units: Units
    actuation: Actuation
    weights: Weights
    synthesis: Synthesis
    reduction: Reduction
    margins: Margins
    controller: ct.StateSpace
    sampled: ct.StateSpace
    displacement: float
    within: float
    free: ClosedLoop
    closed: ClosedLoop
    off: ClosedLoop
    drawn: ClosedLoop
    inside: ClosedLoop | None
    doubt: float
    off_free: ClosedLoop
    inside_free: ClosedLoop | None
    printed_bound: tuple[float, float]
    nothing: tuple[str, ...] = ()
    farthest: float = 0.0

    shares = renamed("shares", "fractions")

    @property
    def fractions(self) -> dict[str, float]:
        """Fraction of the plants of each batch that settle within `within` and keep the arm in its half of the circle [1]."""
        batches = {"parameters_off": self.off, "parameter_covariance": self.drawn, "envelope": self.inside}
        return {name: float(np.mean(one.holds(within=self.within))) for name, one in batches.items() if one is not None}

    @property
    def helps(self) -> bool:
        """Return whether the fitted model settles sooner with the controller than without."""
        return bool(self.closed.settling_time()[0] < self.free.settling_time()[0])

    def overview(self) -> Overview:
        """Return settling, torque and swing of the fitted model with the controller and without."""
        rows = [
            (
                name,
                settling_words(float(one.settling_time()[0])),
                f"{1e3 * float(one.peak_torque[0]):.2f}",
                f"{float(one.arm_swing[0]):.2f}",
            )
            for name, one in (("without", self.free), ("with controller", self.closed))
        ]
        header = ("loop", "settles after", "largest torque [mN m]", "arm swing [rad]")
        title = f"controller of order {self.reduction.controller.nstates}, gamma {self.reduction.gamma:.3f}"
        return Overview(title, header, rows, (str(self.margins),))

    def __str__(self) -> str:
        return "\n".join([*outcome(self), *honesty(self)])

    def plot(self) -> Any:
        """Draw cart, arm and torque of the fitted nonlinear model, with and without the controller (Fig. 8 of the paper)."""
        return draw(self)


def outcome(found: ControlDesign) -> list[str]:
    """Describe what the controller does, in sentences, the answer first."""
    alone, now = (float(r.settling_time()[0]) for r in (found.free, found.closed))
    first = (
        f"Released {1e3 * found.displacement:g} mm off, the cart of the fitted nonlinear model stays under a tenth "
        f"after {settling_words(now)} with the controller and {settling_words(alone)} without; the torque stays within "
        f"{1e3 * float(found.closed.peak_torque[0]):.1f} mN m and the arm swings {float(found.closed.arm_swing[0]):.2f} rad."
    )
    times, before, fractions = found.off.settling_time(), found.off_free.settling_time(), found.fractions
    second = (
        f"Of {len(times)} plants whose parameters are each up to {100 * OFF:.0f} % off, {_percent(times < before)} settle "
        f"sooner than without it, in the median after {settling_words(float(np.median(times)))} instead of "
        f"{settling_words(float(np.median(before)))}; {_percent(fractions['parameters_off'])} settle "
        f"within {found.within:.2f} s, two thirds of what the fitted model takes alone, and keep the arm in its half of the circle "
        f"({_without(found.off_free, found.within)}{_astray(found.off)})."
    )
    beside = f" but {', '.join(found.nothing)}, not told from nothing," if found.nothing else ""
    count, held = len(found.drawn.peak_torque), _percent(fractions["parameter_covariance"])
    third = (
        f"Of {count} plants drawn from the covariance of the fit, in which no free parameter{beside} has a standard deviation "
        f"above {100 * found.doubt:.2g} %, {held} do{_astray(found.drawn)}."
    )
    if found.inside is None:
        fourth = "No plant with parameters near the fitted ones was found in the envelope."
    else:
        fourth = (
            f"Of {len(found.inside.peak_torque)} plants of the envelope, parameters up to {100 * OFF:.0f} % off and damped as much "
            f"as the envelope asks, {_percent(fractions['envelope'])} do "
            f"({_without(found.inside_free, found.within)}{_astray(found.inside)})."
        )
    said = [first, *left_far(found), f"{second} {third} {fourth}"]
    if not now < _USEFUL * alone:
        resonance = _resonance(found)
        width = float(np.max(np.abs(found.covered.weight(1j * resonance))))
        there = int(np.argmin(np.abs(found.covered.frequency - resonance)))
        source = SOURCES[int(np.argmax(found.covered.attribution.fractions[:, there]))]
        if not found.helps:
            said.insert(0, "Do not use this controller: the fitted model settles no sooner with it than without.")
        why, limit = "That is little" if found.helps else "The reason", 1e3 * found.actuation.controller_limit
        robust, _ = found.margins.worst_stability
        asked = found.closed.torque[:, 0] + found.actuation.arm_stiffness * found.closed.arm_angle[:, 0]
        used = float(np.max(np.abs(asked))) / found.actuation.controller_limit
        if robust < _ROOM and used > _USED:
            said.append(
                f"{why}: the torque of {limit:.1f} mN m that the controller may use is small beside what "
                f"{1e3 * found.displacement:g} mm ask for, and not the envelope, of which max |W T| = {robust:.2f} leaves room; "
                "start from a smaller displacement."
            )
            return said
        said.append(
            f"{why}: at the resonance the weight is {width:.2f}; the wider the "
            "envelope is there, the less damping can be promised for all of it. The largest part of the model errors there is "
            f"{SOURCE_WORDS[source]}; what narrows it: {_NARROWER[source]}."
        )
    return said


def honesty(found: ControlDesign) -> list[str]:
    """State what a reader of the paper has to know, and what is not guaranteed."""
    act = found.actuation
    bound, at = found.printed_bound
    stable, _ = found.margins.worst_stability
    performance, where = found.margins.worst_performance
    kept = (
        "is guaranteed for every linear plant of the envelope" if stable < 1 else "is not guaranteed for the envelope"
    )
    return [
        f"This controller: gamma {found.reduction.gamma:.3f} at order {found.reduction.controller.nstates}; with this "
        f"envelope and these weights no controller has less than {found.synthesis.bound:.3f}. Sampled every "
        f"{1e3 * float(found.sampled.dt or 0.0):g} ms, robust stability {kept} "
        f"(max |W T| = {stable:.2f}); robust performance reaches {performance:.2f} at {where:.3g} rad/s and is "
        + ("guaranteed." if performance < 1 else "not guaranteed, which needs less than 1."),
        "That is a theorem for linear plants that do little beyond half of the sampling rate. Of the nonlinear rig it says "
        "nothing: what is said of that comes from simulating the fitted model, and holds as far as that model does.",
        f"With the nominal model and the weights printed in section 5.4 of the paper, since S + T = 1, no controller has a gamma "
        f"below {bound:.3f}, at {at:.1f} rad/s.",
        f"The actuation has rules of its own that are not in the paper: the controller may use {1e3 * act.controller_limit:.1f} "
        f"of the motor's {1e3 * act.motor_limit:.0f} mN m, which limits the swing of the arm, and an electric spring of "
        f"{1e3 * act.arm_stiffness:.2f} mN m/rad brings the arm back to theta = 0, which nothing else on a level rig does. "
        f"The division by cos(theta), and no torque where |cos(theta)| is at most {act.dead_band:g}, are the paper's.",
        f"Coverage: {found.covered.coverage}. That the best of several envelopes was chosen is not counted.",
        f"The weight covers what was recorded, {found.covered.frequency[0]:.3g} to {found.covered.frequency[-1]:.3g} rad/s: beyond "
        "that band it is only continued, and nothing is said there of plants that differ by more.",
        f"P0 has order {len(found.covered.nominal.poles()) - 2} and the spring's two poles.",
        "The recording was made without that spring: each response is multiplied by what the spring does to the linearised "
        "fitted model, and the envelope is made from the products.",
    ]  # fmt: skip


def _resonance(found: ControlDesign) -> float:
    """Return the frequency at which the response of the nominal model is largest [rad/s]."""
    omega = found.covered.frequency
    return float(omega[np.argmax(np.abs(found.covered.nominal_response()))])


def _without(free: ClosedLoop | None, within: float) -> str:
    """Say what the comparison is worth: how many plants settle anyway."""
    if free is None:
        return ""
    fraction = float(np.mean(free.holds(within=within)))
    return f"without a controller {_percent(fraction)} do" + (
        ", so this says little of it" if fraction > _ANYWAY else ""
    )


def left_far(found: ControlDesign) -> list[str]:
    """Say where the fitted model is not the rig's, so that what a controller does for it need not hold there."""
    if found.farthest <= FAR:
        return []
    return [
        f"But the fitted model does not follow the rig, being left at {found.farthest:,.0f} times the noise: times, fractions "
        "and what the controller gains are that model's. Ask est.diagnose what it lacks before the controller is tried."
    ]


def _astray(batch: ClosedLoop) -> str:
    """Say how many plants end badly, if any do."""
    never, wound = int(np.sum(~np.isfinite(batch.settling_time()))), int(np.sum(batch.wound_up))
    said = [f"{never} do not settle while simulated" if never else "", f"{wound} wind up the arm" if wound else ""]
    return "".join(f"; {one}" for one in said if one)


def _percent(which: Bool[np.ndarray, " plant"] | float) -> str:
    return f"{100 * float(np.mean(which)):.1f} %"


def settling_words(value: float) -> str:
    """Return a settling time [s] in words; it is infinite where nothing settles."""
    return f"{value:.2f} s" if np.isfinite(value) else "never in this simulation"
