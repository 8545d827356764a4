"""An effect beside hum of the mains, which sensors pick up."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.measurement import Experiment

_LAG = 0.004


def _with_hum(experiment: Experiment, number: int) -> Experiment:
    """Add 50 Hz to position and velocity, of a phase of its own, about as large as their noise."""
    wave = np.sin(2 * np.pi * 50.0 * np.arange(experiment.samples) * experiment.sample_time + number)
    size = {"cart_position": 3e-5, "arm_velocity": 0.08}
    outputs = {
        name: dataclasses.replace(signal, values=np.asarray(signal.values) + size[name] * wave)
        for name, signal in experiment.outputs.items()
    }
    return dataclasses.replace(experiment, outputs=outputs)


@pytest.mark.slow
def test_a_lag_of_the_current_is_named_beside_hum_of_the_mains(tmp_path: Path) -> None:
    plans = virtual_rig.standard_plans(seed=14, duration=4.0, sample_time=0.002, free=1, forced=4, rest=0)
    clean = virtual_rig.record(virtual_rig.Rig(current_lag=_LAG), plans, seed=14)
    recording = rtac.Recording(tuple(_with_hum(e, n) for n, e in enumerate(clean.experiments)), rig=clean.rig)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert [candidate.id for candidate in found.added] == ["current_lag"]
    lag = found.final.parameters["current_lag.time_constant"]
    assert abs(lag.value - _LAG) < 4 * lag.std
    assert found.headline == "current_lag was missing; the mended model is adequate."
    assert found.ending.startswith(
        "Hum of the mains was subtracted first: cart_position 3e-05 m at 50 Hz and arm_velocity "
    )
    train, _ = recording.split()
    with pytest.raises(ValueError, match=r"or that without its hum of the mains \(recording.without_hum\(\)\)"):
        est.constancy(found.final, train)
    assert est.constancy(found.final, train.without_hum()).equal
    found.save(tmp_path / "better.h5")
    assert est.load(tmp_path / "better.h5").hum == found.hum
