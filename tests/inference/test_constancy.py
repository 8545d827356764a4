"""Are parameters the same in every experiment? On damped oscillators in closed form whose spring depends on what is known."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac

MASS, STIFFNESS, VISCOUS = 1.23, 132.6, 0.5543  # paper, section 4.2
RUNS = 10


def fitted(softening, seed=0):
    """Ten decays; the spring softens with a temperature that follows neither amplitude nor order."""
    random = np.random.default_rng(seed)
    time = 0.02 * np.arange(150)
    rate = VISCOUS / (2 * MASS)
    warm = np.random.default_rng(5).permutation(np.linspace(18.0, 27.0, RUNS))
    experiments = []
    for i, (start, degrees) in enumerate(zip(np.linspace(0.006, 0.015, RUNS), warm, strict=True)):
        damped = np.sqrt(STIFFNESS * (1 - softening * (degrees - 18.0)) / MASS - rate**2)
        position = start * np.exp(-rate * time) * (np.cos(damped * time) + rate / damped * np.sin(damped * time))
        experiments.append(
            rtac.Experiment.of(
                f"free_{i}", kind="free", sample_time=0.02, arm="locked", initial_arm_angle=0.0,
                cart_position=position + 5e-5 * random.standard_normal(150), noise_std={"cart_position": 5e-5},
            )
        )  # fmt: skip
    recording = rtac.Recording(tuple(experiments), rig={"total_mass": MASS})
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    fit = est.output_error(model, recording, progress=False, from_model=True)
    return fit, recording, {f"free_{i}": float(t) for i, t in enumerate(warm)}


def test_a_spring_that_softens_is_named_with_the_temperature():
    fit, recording, warm = fitted(5e-4)
    unknown = est.constancy(fit, recording)
    assert not unknown.equal
    assert unknown.drifting[0] == "spring_stiffness"
    assert unknown.best_trend("spring_stiffness") is None, "nothing that was looked at without the thermometer"
    found = est.constancy(fit, recording, covariates={"temperature": warm})
    trend = found.best_trend("spring_stiffness")
    assert trend is not None
    assert trend.covariate == "temperature"
    assert trend.slope == pytest.approx(-5e-4 * 9.0 * STIFFNESS, rel=0.1)
    assert "Spring_stiffness drifts with temperature" in found.verdict
    # Every experiment's own stiffness, by one step from the common one.
    own = STIFFNESS * (1 - 5e-4 * (np.array(list(warm.values())) - 18.0))
    place = found.names.index("spring_stiffness")
    assert np.all(np.abs(found.values[:, place] - own) < 4 * found.std[:, place] + 0.02)
    assert "drifts" in found.plot().get_suptitle()
    with pytest.raises(ValueError, match="temperature has no value for free_0"):
        est.constancy(fit, recording, covariates={"temperature": {}})


def test_weighed_constants_are_held():
    fit, recording, _ = fitted(0.0)
    weighed = dataclasses.replace(recording, rig_std={"total_mass": 0.005})
    model = rtac.RTAC.from_rig(weighed).without("cart_coulomb")
    found = est.constancy(est.output_error(model, weighed, progress=False, from_model=True), weighed)
    exact = est.constancy(fit, recording)
    assert "total_mass" not in found.names
    assert found.names == exact.names
    np.testing.assert_allclose(found.common_std, exact.common_std, rtol=1e-3)
    assert found.equal
    assert found.p_value == pytest.approx(exact.p_value, abs=1e-3)


def test_constant_parameters_are_called_constant_as_often_as_said():
    p_values = np.array([est.constancy(*fitted(0.0, seed)[:2]).p_value for seed in range(8)])
    assert np.min(p_values) > 1e-3
    assert 0.2 < np.mean(p_values) < 0.85
