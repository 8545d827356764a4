"""What a study holds estimates against, where the virtual rig makes the data."""

import math

import pytest
from small_study import small

from estimators.study import Fitted, Hidden, Plant
from estimators.study.truth import EFFECT_FIELD, true_for
from rtac_jax.effects import CATALOGUE
from rtac_jax.parameters import declarations


@pytest.mark.parametrize("effect", sorted({name.partition(".")[0] for name in EFFECT_FIELD}))
def test_what_is_not_hidden_is_truly_absent(effect):
    values = true_for(small(model=Fitted(effects=(effect,))), 0).values
    assert all(map(math.isfinite, values.values()))
    for name in CATALOGUE[effect].amplitudes():
        null = declarations(CATALOGUE[effect])[name].null
        assert values.get(f"{effect}.{name}", null) == null


def test_a_stop_that_is_hidden_is_held_against_its_fields():
    stop = Hidden("end_stop", {"end_stop_travel": 0.01, "end_stop_stiffness": 300.0})
    truth = true_for(small(model=Fitted(effects=("end_stop",)), plant=Plant(hidden=(stop,))), 0)
    assert truth.values["end_stop.travel"] == 0.01
    assert truth.values["end_stop.stiffness"] == 300.0
