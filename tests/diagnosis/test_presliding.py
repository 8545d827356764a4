"""Dry friction by bristles, hidden in the virtual rig, is named by the whole catalogue; narrow bristles of a cart, too."""

import pytest
from hidden_effects import diagnosed, recorded

HIDDEN = {
    "arm_presliding": {"arm_presliding": 4e-4, "arm_presliding_yield": 0.05},
    "cart_presliding": {"cart_coulomb": 0.0, "cart_presliding": 0.024, "cart_presliding_yield": 1e-5},
}


@pytest.mark.slow
@pytest.mark.parametrize("effect", HIDDEN)
def test_friction_by_bristles_is_named_with_its_size(effect: str) -> None:
    hidden = HIDDEN[effect]
    found = diagnosed(recorded({effect: hidden}, 42)[effect])
    assert found.verdict in ("missing", "ambiguous"), found
    assert effect in {c.id for c in found.effects}, found
    named = next(c for c in found.effects if c.id == effect)
    level = named.parameters["level"]
    assert abs(level.value - hidden[effect]) < 4 * level.std
    assert level.std < 0.1 * hidden[effect]
