"""Recordings of one shape with hidden effects, on rigs drawn around the paper's, and their diagnosis."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect

# Springs, friction, lags and what looks like them: where a test is not about the whole catalogue, which takes four times as long.
SHORT = tuple(
    CATALOGUE[name]
    for name in (
        "cubic_spring", "quadratic_spring", "hysteretic_spring", "cart_stribeck", "cart_quadratic_drag", "flexible_mode",
        "arm_coulomb", "current_lag", "input_delay", "tacho_lag", "lvdt_nonlinearity",
    )
)  # fmt: skip


def recorded(
    hidden: Mapping[str, dict[str, Any]], first: int, *, again: int = 0, noise: int = 0
) -> dict[str, rtac.Recording]:
    """One recording for each set of hidden values; `first` numbers the rigs and what is played on them.

    Another recording of the same rigs has another number `again`; the same experiments once more have another `noise`.
    """
    jobs = []
    for number, values in enumerate(hidden.values(), first):
        rig = virtual_rig.Rig().drawn(100 + number)
        plans = virtual_rig.standard_plans(
            seed=200 + number + 1000 * again, sample_time=0.005, duration=6.0, free=2, forced=4, rest=1, repeats=1
        )
        jobs.append((dataclasses.replace(rig, **values), plans, 300 + number + 1000 * again + 10_000 * noise))
    return dict(zip(hidden, virtual_rig.record_many(jobs), strict=True))


def diagnosed(recording: rtac.Recording, candidates: Sequence[type[Effect]] | None = None) -> est.Diagnosis:
    """With the paper's model as the base, and all of the catalogue or these candidates."""
    model = rtac.RTAC.from_rig(recording)
    fit = est.output_error(model, recording, progress=False)
    return est.diagnose(fit, recording, candidates=candidates, progress=False)


def beyond_noise(compared: est.Comparison, number: int) -> dict[str, float]:
    """Errors of one model's simulations in units of the noise, less what noise explains."""
    errors = compared.models[number].errors
    return {channel: float(np.sqrt(max(e.rms_over_noise**2 - 1.0, 0.0))) for channel, e in errors.items()}
