"""The diagnosis of a measured circuit; notebook 08 shows the rest."""

from pathlib import Path

import pytest

import estimators as est
import rtac_jax as rtac

DATA = Path(__file__).parents[3] / "shared" / "data" / "silverbox" / "SNLS80mV.mat"


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the Silverbox data are not in shared/data/silverbox")
def test_an_input_that_is_wrongly_declared_as_held_is_named_first() -> None:
    train = rtac.Recording.from_mat(
        DATA, channels={"disturbance_force": "V1", "cart_position": "V2"}, sample_time=2**14 / 1e7, kind="forced",
        name="estimation", start=40650, stop=40650 + 9216, intersample="zoh", arm="locked",
    )  # fmt: skip
    model = rtac.RTAC.from_rig(train).without("cart_coulomb") + rtac.effects.ForceOffset(0.0)
    found = est.diagnose(est.output_error(model, train, starts=1, progress=False), train, progress=False)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == ["input_hold", "cubic_spring"], found
