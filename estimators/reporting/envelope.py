"""The output of `rtac envelope`: a dictionary for JSON, tables and sentences."""

from itertools import pairwise
from typing import Any

import control as ct
import numpy as np

from estimators.frequency_response.response import FrequencyResponses
from estimators.linear.fit import LinearModels
from estimators.reporting.html import Table
from estimators.reporting.report import FORMAT, VERSION
from estimators.uncertainty.attribution import SOURCE_WORDS, SOURCES
from estimators.uncertainty.closed_form_check import ClosedFormCheck
from estimators.uncertainty.condition_selection import UsableConditions
from estimators.uncertainty.coverage import Coverage
from estimators.uncertainty.envelope import Envelope
from estimators.uncertainty.fitted_model import FittedInEnvelope

_BANDS = 4
_CANCELS = 0.15  # distance of a zero from a pole, over the pole's size, below which a mode hardly shows


def envelope_dict(
    found: Envelope,
    used: UsableConditions,
    *,
    seconds: float,
    closed_form: ClosedFormCheck | None = None,
    fitted: FittedInEnvelope | None = None,
) -> dict[str, Any]:
    """Return an envelope, ready for `write_json`; complex numbers are pairs of real and imaginary part."""
    distance = found.distance(used.responses)
    inside = distance <= 1
    conditions = [
        {
            "name": one.name,
            "held_out": bool(found.held_out[i]),
            "input_rms": one.input_rms,
            "arm_angle": one.arm_angle,
            "distance": float(distance[i]),
            "inside": bool(inside[i]),
            "response": pairs(one.response),
            "std": one.std.tolist(),
            "gap": found.model_errors[i].tolist(),
        }
        for i, one in enumerate(used.responses)
    ]
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": found.kind,
        "input": "current times cos(theta) [A]",
        "output": "cart_position [m]",
        "nominal": system_dict(found.nominal),
        "weight": system_dict(found.weight),
        "frequency": found.frequency.tolist(),
        "profile": found.profile.tolist(),
        "weight_magnitude": found.weight_magnitude().tolist(),
        "excess_db": found.excess_db,
        "largest_excess_db": found.largest_excess_db,
        "minimise": found.minimise,
        "coverage": coverage_dict(found.coverage),
        "attribution": {name: found.attribution.fractions[i].tolist() for i, name in enumerate(SOURCES)},
        "conditions": conditions,
        "left_out": dict(used.left_out),
        "method": "local" if used.models is None else "prediction-error",
        "closed_form": None
        if closed_form is None
        else {
            "inside": closed_form.inside,
            "in_words": closed_form.words,
            "response": pairs(closed_form.response),
            "needed": closed_form.needed.tolist(),
        },
        "linear_models": None if used.models is None else models_said(used.models),
        "fitted_model": None if fitted is None else fitted_dict(fitted),
        "seconds": seconds,
    }


def fitted_dict(fitted: FittedInEnvelope) -> dict[str, Any]:
    """Return how far the fitted model lies from an envelope."""
    return {
        "agrees": fitted.agrees,
        "distance": fitted.distance,
        "distance_at": fitted.at,
        "nominal_peak_over_fitted_db": fitted.peak_db,
        "resonance": fitted.resonance,
        "spurious_modes": list(fitted.spurious),
        "in_words": fitted.sentences(),
    }


def coverage_dict(coverage: Coverage) -> dict[str, Any]:
    """Return the statement about a new condition."""
    return {
        "probability": coverage.probability,
        "confidence": coverage.confidence,
        "conditions": coverage.conditions,
        "method": coverage.method,
        "in_words": str(coverage),
    }


def system_dict(system: ct.TransferFunction) -> dict[str, Any]:
    """Return zeros, poles and gain, and numerator and denominator in falling powers of s [rad/s]."""
    top, low = (np.trim_zeros(np.asarray(part[0][0], dtype=float), "f") for part in (system.num, system.den))
    return {
        "zeros": pairs(np.asarray(system.zeros())),
        "poles": pairs(np.asarray(system.poles())),
        "gain": float(top[0] / low[0]),
        "numerator": top.tolist(),
        "denominator": low.tolist(),
    }


def models_table(found: Envelope) -> Table:
    """Return a table of nominal model and weight."""
    rows = []
    for name, system in (("P0, nominal model [m/A]", found.nominal), ("W, weight", found.weight)):
        told = system_dict(system)
        rows.append((name, f"{told['gain']:.4g}", roots(system.zeros()), roots(system.poles())))
    return Table(
        ("model", "gain", "zeros [rad/s]", "poles [rad/s]"),
        tuple(rows),
        "Gain, zeros and poles: gain * product of (s - zero) / product of (s - pole).",
    )


def roots(values: np.ndarray) -> str:
    """Format roots as text; a pair is one entry."""
    shown = [v for v in np.sort_complex(np.asarray(values)) if v.imag >= 0]
    return ", ".join(f"{v.real:.4g}" + (f" ± j{v.imag:.4g}" if v.imag > 0 else "") for v in shown) or "none"


def conditions_table(found: Envelope, responses: FrequencyResponses) -> Table:
    """Return a table of the conditions and their distances from the nominal model."""
    distance = found.distance(responses)
    rows = []
    for i, one in enumerate(responses):
        spread = 100 * float(np.median(one.std / np.abs(one.response)))
        at = int(np.argmax(found.model_errors[i]))
        rows.append(
            (
                one.name,
                "held out" if found.held_out[i] else "fitted",
                "" if one.arm_angle is None else f"{one.arm_angle:.2f}",
                f"{1e3 * one.input_rms:.3g}",
                f"{spread:.2g}",
                f"{found.model_errors[i, at]:.2f}",
                f"{found.frequency[at]:.3g}",
                f"{distance[i]:.2f}",
            )
        )
    header = (
        "condition", "use", "mean arm angle [rad]", "current rms [mA]", "std [%]", "largest model error [1]", "at [rad/s]",
        "largest |Δ| [1]",
    )  # fmt: skip
    return Table(header, tuple(rows), "A condition whose largest |Δ| is at most 1 lies inside the envelope.")


def sources_table(found: Envelope) -> Table:
    """Return a table of the model errors' sources, in bands of equal width on a log scale."""
    edges = np.geomspace(found.frequency[0], found.frequency[-1], _BANDS + 1)
    rows = []
    for low, high in pairwise(edges):
        inside = (found.frequency >= low * (1 - 1e-9)) & (found.frequency <= high * (1 + 1e-9))
        if np.any(inside):
            fractions = 100 * found.attribution.fractions[:, inside].mean(axis=1)
            rows.append((f"{low:.3g} to {high:.3g}", *(f"{fraction:.0f}" for fraction in fractions)))
    header = ("band [rad/s]", *(f"{SOURCE_WORDS[name]} [%]" for name in SOURCES))
    return Table(
        header, tuple(rows), "Fractions of the mean squared model error between the conditions and the nominal model."
    )


def remarks(found: Envelope, used: UsableConditions) -> list[str]:
    """State what a reader must know of an envelope beside its numbers."""
    said = [f"Coverage: {found.coverage}."]
    if np.all(found.weight_magnitude() >= 1) and found.kind != "additive":
        said.append(
            "|W| is at least 1 everywhere, so no linear controller can be robust for all of these conditions: they differ in "
            "phase or sign, or the nominal model needs a higher order."
        )
    said += cancelled_modes(found.nominal)
    largest = SOURCES[int(np.argmax(found.attribution.fractions.mean(axis=1)))]
    said.append(
        f"The model errors come mostly from the {SOURCE_WORDS[largest].replace('left by', 'dynamics that are left by')}. "
        + (
            "The responses are estimates by local polynomials, which count nonlinear distortion as noise."
            if used.models is None
            else f"The responses are those of linear models with {used.models.structure.modes} mode(s), by the prediction error "
            "method; what a model lacks is in no standard deviation."
        )
    )
    if used.integrated:
        said.append(
            f"The arm's angle of {', '.join(used.integrated)} was integrated from its velocity, as none was measured; it drifts, "
            "and with it cos(theta)."
        )
    said += _near_ninety_degrees(used)
    said += used.responses.remarks()
    said += [f"Left out: {name}: {why.rstrip('.')}." for name, why in used.left_out.items()]
    return said


def cancelled_modes(nominal: ct.TransferFunction) -> list[str]:
    """Name modes of the nominal model that zeros all but cancel: they follow scatter of the conditions, and no rig's mode."""
    poles: Any = np.asarray(nominal.poles())
    zeros: Any = np.asarray(nominal.zeros())
    said = []
    for pole in poles[poles.imag > 0]:
        if len(zeros) and np.min(np.abs(zeros - pole)) < _CANCELS * np.abs(pole):
            fewer = len(poles) - 2
            said.append(
                f"P0's mode at {np.abs(pole):.3g} rad/s is all but cancelled by zeros beside it: it follows the scatter of the "
                f"conditions rather than a mode of the rig. An order of {fewer} does without it (--order {fewer})."
            )
    return said


def _near_ninety_degrees(used: UsableConditions) -> list[str]:
    """State what the conditions in which the motor hardly moves the cart show, and what they cannot."""
    if not used.without_grip:
        return []
    known = {one.name: 100 * float(np.median(one.std / np.abs(one.response))) for one in used.responses}
    each = ", ".join(
        f"{name} (cos θ of {used.grips[name]:.2g} rms; "
        + (f"known to {known[name]:.0f} %" if name in known else "left out")
        + ")"
        for name in used.without_grip
    )
    return [
        f"Arm near ±90°: {each}. There the coupling vanishes: the motor's push on the cart, the eccentric moment and the arm's "
        "reaction go with cos θ, so the current shows the arm alone (torque constant over inertia, its friction), not the gain "
        "from current to cart, nor the cart's mode, which only a free decay or a push on the cart shows there."
    ]


def models_said(models: LinearModels) -> list[str]:
    """State the verdict on the residuals of linear models, and whether all conditions have the same parameters."""
    return [*models.verdict.splitlines(), _equality(models)]


def _equality(models: LinearModels) -> str:
    try:
        return models.equality().verdict
    except ValueError as error:
        return f"Whether the conditions have the same parameters cannot be told: {error}"


def pairs(values: np.ndarray) -> list[list[float]]:
    """Convert complex numbers for JSON: real and imaginary part."""
    return [[float(v.real), float(v.imag)] for v in np.asarray(values, dtype=complex)]
