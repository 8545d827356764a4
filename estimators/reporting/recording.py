"""The contents of a recording, for JSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estimators.reporting.html import cleaned
from estimators.reporting.report import FORMAT, VERSION
from rtac_jax.measurement import Experiment, Recording


def recording_dict(recording: Recording, found: Sequence[str], *, guarded: bool) -> dict[str, Any]:
    """Return rig, experiments and channels of a recording, ready for `write_json`.

    Args:
        recording: to describe.
        found: its concerns.
        guarded: whether its file carries checksums.
    """
    return cleaned(
        {
            "format": FORMAT,
            "version": VERSION,
            "rig": dict(recording.rig),
            "rig_name": recording.rig_name,
            "comment": recording.comment,
            "checksums": guarded,
            "experiments": [_experiment(experiment) for experiment in recording],
            "concerns": list(found),
        }
    )


def _experiment(experiment: Experiment) -> dict[str, Any]:
    channels = {}
    for name, signal in {**experiment.inputs, **experiment.outputs}.items():
        channels[name] = {
            "unit": signal.unit,
            "rms": float(np.sqrt(np.nanmean(signal.values**2))),
            "smallest": float(np.nanmin(signal.values)),
            "largest": float(np.nanmax(signal.values)),
            "missing": int(np.isnan(signal.values).sum()),
            "noise_std": signal.noise_std,
            "intersample": signal.intersample,
        }
    names = ("name", "kind", "samples", "sample_time", "duration", "initial_arm_angle", "arm", "cart", "repeat_of")
    return {**{name: getattr(experiment, name) for name in names}, "channels": channels}
