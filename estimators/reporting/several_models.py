"""Several models against the same measurements, as a table and for JSON."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from estimators.core.fit import Fit
from estimators.reporting.html import Table, cleaned
from estimators.reporting.report import FORMAT, VERSION
from estimators.validation.simulation_error import Comparison
from rtac_jax import RTAC


def models_table(train: Comparison, validation: Comparison | None) -> Table:
    """Return a table of the error of every model in every channel, for both sides of the split."""
    rows = [
        (which, model.label, channel, f"{e.fit_percent:.2f}", f"{e.rms:.3g}", f"{e.rms_over_noise:.2f}")
        for which, comparison in (("train", train), ("validation", validation))
        if comparison is not None
        for model in comparison.models
        for channel, e in model.errors.items()
    ]
    header = ("data", "model", "channel", "fit [%]", "rms [SI]", "rms/noise")
    return Table(header, tuple(rows), "Error of free simulation; the noise is that of the sensor.")


def models_dict(
    fits: Sequence[Fit | RTAC], train: Comparison, validation: Comparison | None, *, seconds: float
) -> dict[str, Any]:
    """Return parameters and errors of every model, ready for `write_json`."""
    found = []
    for number, fit in enumerate(fits):
        sides = {"train": train, "validation": validation}
        errors = {
            side: None
            if comparison is None
            else {channel: dataclasses.asdict(e) for channel, e in comparison.models[number].errors.items()}
            for side, comparison in sides.items()
        }
        found.append({"label": train.models[number].label, "parameters": _parameters(fit), "error": errors})
    return cleaned({"format": FORMAT, "version": VERSION, "models": found, "seconds": seconds})


def _parameters(fit: Fit | RTAC) -> dict[str, Any]:
    if isinstance(fit, Fit):
        return {name: dataclasses.asdict(parameter) for name, parameter in fit.parameters.items()}
    return {
        name: {"value": float(np.mean(np.asarray(fit[name]))), "std": math.nan, "unit": declared.unit}
        for name, declared in fit.parameters.items()
        if name not in fit.per_experiment
    }
