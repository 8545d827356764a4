"""A drive whose fine encoder leaves predictions one sample ahead nothing to tell: the simulation says what is missing."""

import pytest
from positioning_axis import COULOMB, OFFSET, TORQUE_CONSTANT, as_cart, axis, recording

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import stepwise_selection
from estimators.plots.diagnosis import finding
from rtac_jax.effects import ArmCoulomb, ArmPresliding, CubicSpring, CurrentOffset, EncoderLag, ForceOffset, GravityTilt


@pytest.mark.slow  # test_simulation_selection.py asserts in every run how simulations select
def test_dry_friction_is_named_and_no_lag_of_the_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    train = recording().select(["forth and back"])
    fit = est.output_error(rtac.RTAC.from_rig(train), train, progress=False)
    found = est.diagnose(fit, train, candidates=[ArmCoulomb, CurrentOffset, EncoderLag], thorough=False, progress=False)
    assert found.verdict == "missing"
    assert found.effects[0].id == "arm_coulomb"
    assert "encoder_lag" not in [c.id for c in found.effects]
    assert "This is what simulations select" in found.explanation
    assert f"{100 * found.removed:.0f} % of the simulation's squared error" in found.explanation
    assert f"explain {100 * found.removed:.0f} % of the simulation's squared error" in finding(found).replace(
        "explains", "explain"
    )
    assert all(c.can_show for c in found.candidates if c.id in {c.id for c in found.effects})
    assert found.evidence is not None
    again = est.judge(found.evidence)
    assert (again.verdict, again.effects, again.incomplete) == ("missing", tuple(c.id for c in found.effects), ())
    monkeypatch.setattr(stepwise_selection, "selected_by_simulation", lambda *_: None)
    by_predictions = est.judge(found.evidence)
    assert by_predictions.effects[0] == "encoder_lag"


@pytest.mark.slow
def test_the_loop_finds_friction_and_offset_and_the_axis() -> None:
    both = recording()
    found = est.improve(
        rtac.RTAC.from_rig(both), both, validation=["other moves"], progress=False,
        candidates=[ArmCoulomb, ArmPresliding, CurrentOffset, EncoderLag],
    )  # fmt: skip
    assert [c.id for c in found.added] == ["arm_coulomb", "current_offset"]
    assert found.diagnoses[-1].verdict == "adequate"
    assert found.final.parameters["arm_coulomb.level"].value == pytest.approx(COULOMB, rel=0.01)
    assert found.final.parameters["current_offset.offset"].value == pytest.approx(-OFFSET / TORQUE_CONSTANT, rel=0.02)


@pytest.mark.slow
def test_a_cart_without_spring_has_its_offset_named() -> None:
    """What is plausible is a fraction of the forces, of which the spring's are none."""
    moves = axis("forth and back", 6.0, sizes=(0.24, 0.14, 0.07), period=3.0, sample_time=4e-3)
    train = rtac.Recording([as_cart(moves)], rig={})
    fit = est.output_error(rtac.RTAC.from_rig(train), train, progress=False)
    few = [ForceOffset, GravityTilt, CubicSpring]
    found = est.diagnose(fit, train, candidates=few, thorough=False, progress=False)
    assert found.verdict == "missing"
    assert [c.id for c in found.effects] == ["force_offset"]  # a tilt is the same, beside an arm that is locked
    assert found.effects[0].confusable_with == ()
    assert found.effects[0].parameters["offset"].value == pytest.approx(-OFFSET, rel=0.02)
