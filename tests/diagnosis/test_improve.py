"""The loop on recordings of the independent virtual rig: the error falls to the noise on experiments no fit has seen."""

import dataclasses

import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

# tests/test_demo.py runs the same loop on another effect every time.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def improved() -> est.Improvement:
    rig = dataclasses.replace(virtual_rig.Rig().drawn(7), arm_coulomb=4e-4)
    plans = virtual_rig.standard_plans(seed=8, sample_time=0.005, duration=6.0, free=4, forced=4, rest=1)
    recording = virtual_rig.record(rig, plans, seed=9)
    return est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)


def test_the_error_of_held_out_experiments_falls_to_the_noise(improved: est.Improvement) -> None:
    assert improved.verdict == "missing", improved
    assert [c.id for c in improved.added] == ["arm_coulomb"]
    before, after = improved.validation.models[0].errors, improved.validation.models[-1].errors
    for channel in after:
        assert after[channel].rms_over_noise < 1.2
    assert max(e.rms_over_noise for e in before.values()) > 2.0
    assert "arm_coulomb" in improved.final.model
    assert improved.diagnoses[-1].verdict == "adequate"
    assert len(improved.fits) == len(improved.train.models) == 2


def test_held_out_experiments_were_not_fitted(improved: est.Improvement) -> None:
    held_out = {t.experiment for t in improved.validation.models[0].traces}
    assert held_out == {"free_4", "forced_4"}
    assert not held_out & set(improved.base.experiments)
