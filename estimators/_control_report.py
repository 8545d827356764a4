"""What `rtac control` writes: dictionaries for JSON and MAT, tables and sentences."""

from collections.abc import Mapping
from typing import Any

import control as ct
import numpy as np

from estimators._attribution import SOURCES
from estimators._control_design import OFF, ControlDesign
from estimators._envelope_report import SOURCE_WORDS, coverage_dict, roots, system_dict
from estimators._report import FORMAT, VERSION
from estimators._report_file import Table
from rtac_jax.control import ClosedLoop

WEIGHTED = "P0 keeps closest to the responses where they are large, as limited torque does nothing elsewhere."
_ANYWAY = 0.9  # share of plants that hold without a controller, above which a batch says little of it
_USEFUL = 0.8  # share of the settling time, above which a controller is of little use
_USED = 0.8  # of the torque that it may use, above which a controller uses it
_ROOM = 0.3  # of the largest |W T|, below which it is not the envelope that holds a controller back
_NARROWER = {
    "unmodelled": "an order of the nominal model or a band that suit the conditions better (--order, --band)",
    "amplitude": "conditions whose amplitudes differ less, as dry friction damps small motions more than large ones",
    "scatter": "conditions that differ less, such as arms that start and stay closer to where they push most",
    "estimation": "longer records, or currents that are larger around the resonance",
}


def design_dict(found: ControlDesign, fit_parameters: Mapping[str, Any], *, seconds: float) -> dict[str, Any]:
    """A controller and what it achieves, ready for `write_json`."""
    synthesis = found.synthesis
    return {
        "format": FORMAT,
        "version": VERSION,
        "coverage": coverage_dict(found.covered.coverage),
        "gamma": found.reduction.gamma,
        "gamma_full_order": synthesis.gamma,
        "gamma_bound": synthesis.bound,
        "gamma_bound_of_printed_weights": found.printed_bound[0],
        "robust_stability": found.margins.worst_stability[0],
        "robust_performance": found.margins.worst_performance[0],
        "controller": {
            "law": "torque = clip(u / cos(theta), controller_limit) - arm_stiffness * theta, clipped at motor_limit, "
            "and 0 where |cos(theta)| <= dead_band; u = -C cart_position",
            "input": "cart_position [m]",
            "output": "torque [N m]",
            "continuous": _matrices(found.controller),
            "sampled": {**_matrices(found.sampled), "sample_time": float(found.sampled.dt or 0.0)},
        },
        "actuation": {
            "controller_limit": found.actuation.controller_limit,
            "motor_limit": found.actuation.motor_limit,
            "arm_stiffness": found.actuation.arm_stiffness,
            "dead_band": found.actuation.dead_band,
        },
        "nominal": system_dict(found.covered.nominal),
        "weight": system_dict(found.covered.weight),
        "displacement": found.displacement,
        "within": found.within,
        "open_loop": _loop(found.free),
        "closed_loop": _loop(found.closed),
        "batches": {
            name: {
                "plants": len(batch.peak_torque),
                "share_that_holds": found.shares[name],
                "share_that_holds_without": None if free is None else float(np.mean(free.holds(within=found.within))),
                "never_settle": int(np.sum(~np.isfinite(batch.settling_time()))),
                "wound_up": int(np.sum(batch.wound_up)),
            }
            for name, batch, free in (
                ("parameters_off", found.off, found.off_free),
                ("parameter_covariance", found.drawn, None),
                ("envelope", found.inside, found.inside_free),
            )
            if batch is not None
        },
        "parameters": dict(fit_parameters),
        "seconds": seconds,
    }


def design_mat(found: ControlDesign) -> dict[str, Any]:
    """The same controllers as matrices, for `scipy.io.savemat`."""
    sampled = {**_arrays(found.sampled), "sample_time": float(found.sampled.dt or 0.0)}
    actuation = found.actuation
    return {
        "C": _arrays(found.controller),
        "C_sampled": sampled,
        "controller_limit": actuation.controller_limit, "motor_limit": actuation.motor_limit,
        "arm_stiffness": actuation.arm_stiffness, "dead_band": actuation.dead_band,
        "gamma": found.reduction.gamma, "time": found.closed.time, "cart_position": found.closed.cart_position,
        "arm_angle": found.closed.arm_angle, "torque": found.closed.torque,
    }  # fmt: skip


def outcome(found: ControlDesign) -> list[str]:
    """What the controller does, in sentences, the answer first."""
    alone, now = (float(r.settling_time()[0]) for r in (found.free, found.closed))
    first = (
        f"Released {1e3 * found.displacement:g} mm off, the cart of the fitted nonlinear model stays under a tenth "
        f"after {_seconds(now)} with the controller and {_seconds(alone)} without; the torque stays within "
        f"{1e3 * float(found.closed.peak_torque[0]):.1f} mN m and the arm swings {float(found.closed.arm_swing[0]):.2f} rad."
    )
    times, before, shares = found.off.settling_time(), found.off_free.settling_time(), found.shares
    second = (
        f"Of {len(times)} plants whose parameters are each up to {100 * OFF:.0f} % off, {_percent(times < before)} settle "
        f"sooner than without it, in the median after {_seconds(float(np.median(times)))} instead of "
        f"{_seconds(float(np.median(before)))}; {_percent(shares['parameters_off'])} settle within {found.within:.2f} s, two "
        f"thirds of what the fitted model takes alone, and keep the arm in its half of the circle "
        f"({_without(found.off_free, found.within)}{_astray(found.off)})."
    )
    third = (
        f"Of {len(found.drawn.peak_torque)} plants drawn from the covariance of the fit, in which no free parameter has a standard "
        f"deviation above {100 * found.doubt:.2g} %, {_percent(shares['parameter_covariance'])} do{_astray(found.drawn)}."
    )
    if found.inside is None:
        fourth = "No plant with parameters near the fitted ones was found in the envelope."
    else:
        fourth = (
            f"Of {len(found.inside.peak_torque)} plants of the envelope, parameters up to {100 * OFF:.0f} % off and damped as much "
            f"as the envelope asks, {_percent(shares['envelope'])} do "
            f"({_without(found.inside_free, found.within)}{_astray(found.inside)})."
        )
    said = [first, f"{second} {third} {fourth}"]
    if not now < _USEFUL * alone:
        resonance = _resonance(found)
        width = float(np.max(np.abs(found.covered.weight(1j * resonance))))
        there = int(np.argmin(np.abs(found.covered.frequency - resonance)))
        source = SOURCES[int(np.argmax(found.covered.attribution.shares[:, there]))]
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
            "envelope is there, the less damping can be promised for all of it. The largest part of the gaps there is "
            f"{SOURCE_WORDS[source]}; what narrows it: {_NARROWER[source]}."
        )
    return said


def honesty(found: ControlDesign) -> list[str]:
    """What a reader of the paper has to know, and what is not guaranteed."""
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


def design_table(found: ControlDesign) -> Table:
    """Open against closed loop."""
    rows = []
    for name, one in (("without controller", found.free), ("with controller", found.closed)):
        rows.append(
            (
                name,
                _seconds(float(one.settling_time()[0])),
                f"{1e3 * float(one.peak_torque[0]):.2f}",
                f"{1e3 * float(one.effort[0]):.2f}",
                f"{float(one.arm_swing[0]):.2f}",
                "yes" if one.wound_up[0] else "no",
            )
        )
    return Table(
        ("loop", "settling time", "largest torque [mN m]", "rms torque [mN m]", "arm swing [rad]", "arm wound up"),
        tuple(rows),
        "The fitted nonlinear model; settled: under a tenth of the displacement. The closed loop has the sensors' noise.",
    )


def controller_table(found: ControlDesign) -> Table:
    """The sampled controller as poles, zeros and gain."""
    system = found.sampled
    rows = (
        ("order", str(system.nstates)),
        ("sample time", f"{1e3 * float(system.dt or 0.0):g} ms"),
        ("zeros in z", roots(system.zeros())),
        ("poles in z", roots(system.poles())),
        ("gain at rest", f"{float(np.real(system.dcgain())):.3g} N m/m"),
    )
    return Table(("controller", "u = -C q"), rows, "The matrices are in the JSON and MAT files.")


def _loop(one: ClosedLoop) -> dict[str, Any]:
    return {
        "settling_time": float(one.settling_time()[0]),
        "peak_torque": float(one.peak_torque[0]),
        "rms_torque": float(one.effort[0]),
        "arm_swing": float(one.arm_swing[0]),
        "wound_up": bool(one.wound_up[0]),
    }


def _arrays(system: ct.StateSpace) -> dict[str, Any]:
    return {part: np.asarray(getattr(system, part), dtype=float) for part in "ABCD"}


def _matrices(system: ct.StateSpace) -> dict[str, Any]:
    return {part: values.tolist() for part, values in _arrays(system).items()}


def _resonance(found: ControlDesign) -> float:
    """Of the nominal model, where its response is largest [rad/s]."""
    omega = found.covered.frequency
    return float(omega[np.argmax(np.abs(found.covered.nominal_response()))])


def _without(free: ClosedLoop | None, within: float) -> str:
    """What the comparison is worth: how many plants hold anyway."""
    if free is None:
        return ""
    share = float(np.mean(free.holds(within=within)))
    return f"without a controller {_percent(share)} do" + (", so this says little of it" if share > _ANYWAY else "")


def _astray(batch: ClosedLoop) -> str:
    """Plants that end badly, if any do."""
    never, wound = int(np.sum(~np.isfinite(batch.settling_time()))), int(np.sum(batch.wound_up))
    said = [f"{never} do not settle while simulated" if never else "", f"{wound} wind up the arm" if wound else ""]
    return "".join(f"; {one}" for one in said if one)


def _percent(which: Any) -> str:
    return f"{100 * float(np.mean(which)):.1f} %"


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if np.isfinite(value) else "never in this simulation"
