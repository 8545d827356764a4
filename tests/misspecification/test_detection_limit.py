"""From which size on a candidate would be found, where what it changes is not in proportion to its size."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_effects import recorded

import estimators as est
import rtac_jax as rtac
from rtac_jax import parameter
from rtac_jax.effects import CATALOGUE, CubicSpring, Force


@pytest.fixture(scope="module")
def nothing() -> tuple[est.Fit, rtac.Recording]:
    recording = recorded({"nothing": {}}, first=40)["nothing"]
    return est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False), recording


def test_a_drive_that_never_saturates_is_said_to_show_only_from_where_it_does(
    nothing: tuple[est.Fit, rtac.Recording],
) -> None:
    fit, recording = nothing
    offered = [CATALOGUE[i] for i in ("saturation", "cubic_spring", "encoder_gain", "encoder_lag")]
    found = est.diagnose(fit, recording, candidates=offered, thorough=False, progress=False)
    known = {c.id: c for c in found.candidates}
    largest = max(float(np.max(np.abs(e.inputs["current"].values))) for e in recording if "current" in e.inputs)
    assert 1 / largest < known["saturation"].detection_limit < 2 / largest
    # Nobody measured the angle: what its sensor does is not passed over in silence.
    assert not known["encoder_gain"].testable
    assert "could not show encoder_gain, encoder_lag" in found.explanation
    with pytest.raises(ValueError, match="no candidate is left: nothing in the recording could show encoder_gain"):
        est.diagnose(fit, recording, candidates=offered[2:3], progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["saturation", "cubic_spring"])
def test_an_effect_is_found_at_twice_its_limit_and_not_at_a_third(
    nothing: tuple[est.Fit, rtac.Recording], name: str
) -> None:
    """On the rig of which the limit was stated, with other noise; a drive saturates at one over its size."""
    offered = [CATALOGUE[name], CATALOGUE["current_lag"]]
    stated = est.diagnose(*nothing, candidates=offered, thorough=False, progress=False)
    (limit,) = (c.detection_limit for c in stated.candidates if c.id == name)
    sizes = {share: limit * share for share in (2.0, 1 / 3)}
    hidden = {f"{share:g}": {name: 1 / size if name == "saturation" else size} for share, size in sizes.items()}
    for number, (share, values) in enumerate(hidden.items()):
        recording = recorded({"same rig": values}, first=40, noise=1 + number)["same rig"]
        fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
        found = est.diagnose(fit, recording, candidates=offered, thorough=False, progress=False)
        # What is found may buy so little that the model stays adequate.
        assert [c.id for c in (*found.effects, *found.detectable)] == ([name] if number == 0 else []), (share, found)


@pytest.mark.slow
def test_a_parameter_of_each_experiment_does_not_blame_a_candidate(nothing: tuple[est.Fit, rtac.Recording]) -> None:
    """The innovations that candidates are held against are those of the predictor's own values."""
    _, recording = nothing
    model = rtac.RTAC.from_rig(recording).each_experiment("cart_coulomb.level")
    fit = est.output_error(model, recording, from_model=True, progress=False)
    found = est.diagnose(fit, recording, candidates=[CubicSpring], thorough=False, progress=False)
    assert found.verdict == "adequate", found


class Root(Force):
    """Of which a user forgot that the cart moves to both sides."""

    id: ClassVar[str] = "root"
    equation: ClassVar[str] = "-k sqrt(q)"
    source: ClassVar[str] = "own rig"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"
    strength: Any = parameter(symbol="k", unit="N/m^0.5", meaning="strength", null=0.0, plausible=0.1)

    def force(self, motion: Any, own: Any) -> tuple[Any, Any]:
        return -self.strength * jnp.sqrt(motion.cart_position + 1e-4), 0.0


@pytest.mark.slow
def test_an_effect_that_is_not_nothing_at_null_does_not_blind_the_others(
    nothing: tuple[est.Fit, rtac.Recording],
) -> None:
    with pytest.raises(ValueError, match="candidates: root changes what the model predicts although"):
        est.diagnose(*nothing, candidates=[CubicSpring, Root], thorough=False, progress=False)
