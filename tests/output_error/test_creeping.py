"""A descent that is ended where it creeps, far from the data, loses nothing: side by side with one that goes on to its end."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.active_bounds import solve_bounded
from estimators.output_error import descent
from rtac_jax import virtual_rig

GROSS = {
    "cable": {"cable_stiffness": 0.05, "cable_home": 0.4},
    "vertical arm": {"tilt_across": math.pi / 2},
    "detent": {"detent_force": 0.3},
}


def _solved(*given: Any, beyond: float, **options: Any) -> Any:
    return solve_bounded(*given, **{**options, "far": beyond})


@pytest.mark.slow
def test_what_creeps_is_left_no_farther_off_and_takes_fewer_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    farther, passes, crept = [], np.zeros(2), 0
    for hidden in GROSS.values():
        for seed in range(4):
            rig = dataclasses.replace(virtual_rig.Rig().drawn(600 + seed), **hidden)
            plans = virtual_rig.standard_plans(
                seed=600 + seed, sample_time=0.005, duration=5.0, free=1, forced=3, rest=1, current_rms=0.16
            )
            recording = virtual_rig.record(rig, plans, seed=700 + seed)
            fits = []
            for far in (math.inf, descent.FAR):
                monkeypatch.setattr(descent, "solve_bounded", functools.partial(_solved, beyond=far))
                fits.append(est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False))
            farther.append(fits[1].farthest / fits[0].farthest)
            passes += [fit.statistics["steps"] for fit in fits]
            crept += bool(fits[1].result == est.RESULTS.crept)
    assert max(farther) < 1.05
    assert passes[1] < 0.9 * passes[0]
    assert crept >= 3
