"""The size of coloured noise that no record at rest shows: fast changes show a part of it only."""

import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.noise_colour import assumed_noise, coloured, recoloured
from estimators.diagnosis.setting import setting_of
from estimators.diagnosis.workers import Workers
from rtac_jax import virtual_rig


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "credible"), [(0.6, True), (0.95, False)])
def test_assumed_noise_has_its_size_where_that_is_credible_beside_fast_changes(
    correlation: float, credible: bool
) -> None:
    """Of a correlation of 0.95 fast changes show a sixth: it may as well be something else that is slow."""
    rig = virtual_rig.Rig(noise_correlation=correlation, quantisation_bits=None)
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.004, duration=4.0, free=1, forced=2, rest=0)
    recording = virtual_rig.record(rig, plans, seed=5)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [rtac.effects.Cogging], Progress("diagnose", show=False))
    base = fit_base(setting)
    assert assumed_noise(setting, base, fit.noise) == {}  # nothing is assumed
    white = base.predictor.log_likelihood
    with_colours = coloured(setting, base, Workers(), beside=white)
    assert with_colours is not None
    assert "cart_position" in with_colours.assumed
    fitted = recoloured(with_colours, fit_base(with_colours))[1].predictor.log_likelihood
    assert coloured(setting, base, Workers(), beside=fitted) is not None  # with what the physics gain by it in sight
    assert coloured(setting, base, Workers(), beside=white + 5 * (fitted - white)) is None  # far behind effects
    found = assumed_noise(with_colours, fit_base(with_colours), fit.noise)
    assert bool(found) == credible
    if credible:
        assert set(found) == set(with_colours.assumed) == {"cart_position", "arm_velocity"}
        assert found["cart_position"] == pytest.approx(rig.position_noise, rel=0.1)
        assert found["arm_velocity"] == pytest.approx(rig.velocity_noise, rel=0.1)
        assert all(fit.residual_std[c] / size < 1.1 < fit.residual_over_noise[c] for c, size in found.items())
