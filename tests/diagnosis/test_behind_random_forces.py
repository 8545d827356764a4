"""What large random forces hide: on the independent virtual rig a backlash that no test shows, and forces that nothing makes."""

import dataclasses

import pytest
from known_search import Known, known, sized

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import select
from estimators.misspecification.findings import Findings
from rtac_jax import virtual_rig


def diagnosed(draw, forces, **hidden):
    """Return the verdict on a drawn rig that is shaken by random forces, so many times those of the study."""
    rig = dataclasses.replace(
        virtual_rig.Rig().drawn(draw), encoder=True, force_noise=1e-3 * forces, torque_noise=3e-5 * forces, **hidden
    )
    plans = virtual_rig.standard_plans(seed=draw + 6, free=1, forced=3, rest=0, sample_time=0.002, duration=2.0)
    recording = virtual_rig.record(rig, plans, seed=31 * draw + 6)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    return est.diagnose(fit, recording, progress=False)


@pytest.mark.slow
def test_a_backlash_that_no_test_shows_is_found_behind_large_random_forces():
    found = diagnosed(511, 0.4, backlash=0.01)
    assert found.verdict == "missing", found.explanation
    assert [effect.id for effect in found.effects] == ["backlash"]
    gap = found.effects[0].parameters["gap"]
    assert gap.value == pytest.approx(0.01, rel=0.2)
    assert "backlash raised no alarm by itself: the random forces hid it" in found.explanation


@pytest.mark.slow
@pytest.mark.parametrize(("draw", "forces"), [(502, 4.0), (502, 16.0), (503, 8.0), (500, 8.0)])
def test_random_forces_that_nothing_makes_are_called_nothing_else(draw, forces):
    found = diagnosed(draw, forces)
    assert max(found.random_force, found.random_torque) > STANDARD.random_large
    assert found.effects == ()
    assert found.verdict in ("adequate", "unknown")


class Masked(Known):
    """A rig whose predictor asks for a random torque, of which some is left with the contact that nothing shows."""

    def __init__(self, torque, left, gain=5000.0):
        super().__init__(known(base=0.0, backlash=gain))
        self.base, self.left, self.asked = dataclasses.replace(self.base, random_torque=torque), left, []

    def findings(self, model):
        return Findings()

    def quiet_scores(self, model):
        return (sized("backlash", 1e6, 1e-9), sized("arm_stribeck", 1e6, 1e-9))

    def refits(self, before, several, way):
        self.asked += [s.id for s in several]
        found = super().refits(before, several, way)
        return {i: dataclasses.replace(model, random_torque=self.left) for i, model in found.items()}


@pytest.mark.parametrize(
    ("torque", "left", "gain", "asked", "named"),
    [
        (0.3, 0.03, 5000.0, ["backlash"], ["backlash"]),
        (0.3, 0.09, 5000.0, ["backlash"], ["backlash"]),
        (0.3, 0.1, 5000.0, ["backlash"], []),
        (0.3, 0.03, 1.0, ["backlash"], []),
        (0.049, 0.001, 5000.0, [], []),
    ],
    ids=["takes their place", "nearly", "leaves too much", "makes nothing likelier", "none are large"],
)
def test_what_is_masked_is_named_if_it_takes_the_place_of_the_random_forces(torque, left, gain, asked, named):
    laboratory = Masked(torque, left, gain)
    found = select(laboratory, STANDARD, thorough=True)
    assert (laboratory.asked, [step.id for step in found.steps]) == (asked, named)
    assert found.hid == bool(named)
    assert select(Masked(torque, left, gain), STANDARD, thorough=False).steps == []
