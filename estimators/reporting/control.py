"""The output of `rtac control`: dictionaries for JSON and MAT, tables and sentences."""

from collections.abc import Mapping
from typing import Any

import control as ct
import numpy as np

from estimators.controller.outcome import ControlDesign, settling_words
from estimators.reporting.envelope import coverage_dict, fitted_dict, roots, system_dict
from estimators.reporting.html import Table
from estimators.reporting.report import FORMAT, VERSION
from estimators.uncertainty.fitted_model import FittedInEnvelope
from rtac_jax.control import ClosedLoop

WEIGHTED = "P0 keeps closest to the responses where they are large, as limited torque does nothing elsewhere."


def design_dict(
    found: ControlDesign, fit_parameters: Mapping[str, Any], *, seconds: float, fitted: FittedInEnvelope
) -> dict[str, Any]:
    """Return a controller and what it achieves, ready for `write_json`."""
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
                "share_that_holds": found.fractions[name],
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
        "fitted_model": fitted_dict(fitted),
        "parameters": dict(fit_parameters),
        "seconds": seconds,
    }


def design_mat(found: ControlDesign) -> dict[str, Any]:
    """Return the same controllers as matrices, for `scipy.io.savemat`."""
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


def design_table(found: ControlDesign) -> Table:
    """Return a table of open against closed loop."""
    rows = []
    for name, one in (("without controller", found.free), ("with controller", found.closed)):
        rows.append(
            (
                name,
                settling_words(float(one.settling_time()[0])),
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
    """Return a table of the sampled controller as poles, zeros and gain."""
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
