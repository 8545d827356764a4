"""Dry friction by bristles, hidden in the virtual rig, is named by the whole catalogue; narrow bristles of a cart, too."""

import pytest
from hidden_effects import diagnosed, recorded

import estimators as est
import rtac_jax as rtac
from rtac_jax.effects import CATALOGUE

HIDDEN = {
    "arm_presliding": {"arm_presliding": 4e-4, "arm_presliding_yield": 0.05},
    "cart_presliding": {"cart_coulomb": 0.0, "cart_presliding": 0.024, "cart_presliding_yield": 1e-5},
}


def named_in(effect: str) -> tuple[rtac.Recording, est.Candidate]:
    """Return the recording of an effect, and what its diagnosis says of it."""
    recording = recorded({effect: HIDDEN[effect]}, 42)[effect]
    found = diagnosed(recording)
    assert found.verdict in ("missing", "ambiguous"), found
    assert effect in {c.id for c in found.effects}, found
    return recording, next(c for c in found.effects if c.id == effect)


@pytest.mark.slow
def test_friction_of_the_arm_by_bristles_is_named_with_its_size() -> None:
    _, named = named_in("arm_presliding")
    level, hidden = named.parameters["level"], HIDDEN["arm_presliding"]["arm_presliding"]
    assert abs(level.value - hidden) < 4 * level.std
    assert level.std < 0.1 * hidden


@pytest.mark.slow
def test_friction_of_a_cart_by_narrow_bristles_is_named_with_its_size() -> None:
    """Its level is told apart badly from the model's own dry friction, which is nothing at the least: it is fitted without that."""
    recording, named = named_in("cart_presliding")
    hidden = HIDDEN["cart_presliding"]["cart_presliding"]
    assert named.parameters["level"].std < 0.1 * hidden
    effect = CATALOGUE["cart_presliding"](**{name: p.value for name, p in named.parameters.items()})
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb") + effect
    level = est.output_error(model, recording, progress=False).parameters["cart_presliding.level"]
    assert abs(level.value - hidden) < 4 * level.std
    assert level.std < 0.001 * hidden
