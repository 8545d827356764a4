"""The maximum of the likelihood, with gains that follow the physics: whether standard deviations are right, and its edges."""

import re
from dataclasses import replace

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.results import DivergedError, NotIdentifiableError
from estimators.prediction_error import fisher_scoring as _maximum_likelihood
from estimators.prediction_error.filter_pass import score_noise
from rtac_jax.virtual_rig import Rig, record, standard_plans

SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}


def recorded(rig, seed):
    plans = standard_plans(seed=seed, sample_time=0.005, duration=5.0, free=2, forced=4, rest=1)
    return record(rig, plans, seed=seed)


@pytest.mark.slow
def test_what_changes_the_gains_of_the_filter_is_as_sure_as_it_says():
    """The gain of the cart's sensor changes the gains of the filter, and where an experiment begins.

    With the start held where that sensor shows it, it would be half of the truth. With the filter's gains frozen, its standard
    deviation would be half of what it is: over one to either side the likelihood would fall by 0.2 to 0.3.
    """
    rig = Rig(lvdt_gain=1.1, **SHAKEN)
    truth = {
        "lvdt_gain.error": 0.1,
        "eccentric_moment": rig.eccentric_moment,
        "cart_viscous.coefficient": rig.cart_viscous,
    }
    off = []
    for seed in (11, 12, 13, 14):
        data = recorded(rig, seed)
        model = rtac.RTAC.from_rig(data) + rtac.effects.CATALOGUE["lvdt_gain"](error=0.0)
        found = est.prediction_error_nonlinear(model, data, progress=False)
        off.append([(found.parameters[n].value - t) / found.parameters[n].std for n, t in truth.items()])
        for name in found.information.names:
            assert fall_over_one_deviation(found, name) == pytest.approx(0.5, abs=0.06), name
    scores = np.array(off)
    assert np.all(np.abs(scores.sum(axis=0)) / np.sqrt(len(scores)) < 3), scores


def fall_over_one_deviation(found, name):
    """Of the log-likelihood, one standard deviation of a parameter away, all else following; 0.5 where that is right."""
    known, a = found.information, found.problem.arguments
    column = known.names.index(name)
    along = known.covariance[:, column] / np.sqrt(known.covariance[column, column])
    places = np.array([a.space.names.index(n) for n in known.names])
    shared, each, start = a.space.physical(found.problem.unknowns)

    def value(share):
        physical = (shared.at[places].add(share * along), each, start)
        passed = score_noise(a.model, a.data, a.space, physical, found.prior, found.noise_exponents, a.substeps)
        slope = passed.slope() + tight * found.noise_exponents
        curvature = passed.curvature().information + np.diag(tight)
        return passed.value - 0.5 * slope @ np.linalg.solve(curvature, slope)  # the noise follows

    tight = np.concatenate([np.zeros(2), found.prior.doubt**-2])
    return 0.5 * (value(1.0) + value(-1.0)) - value(0.0)


def held_by_friction(current_rms, **disturbances):
    """Record a rig whose cart begins at the spring's rest, from where so small a current hardly moves it against friction."""
    rig = Rig(cart_coulomb=0.05, arm_inertia=2.4e-4, **disturbances)
    plans = standard_plans(seed=1, duration=6.0, free=0, forced=4, current_rms=current_rms)
    data = record(rig, [replace(plan, initial_position=0.0) for plan in plans], seed=2)
    return rtac.RTAC.from_rig(data).release("arm_inertia"), data


@pytest.mark.slow
@pytest.mark.parametrize("disturbances", [{}, {"torque_noise": 1e-5}], ids=["at rest", "shaken"])
def test_the_inertia_of_an_arm_whose_cart_friction_holds_is_as_unsure_as_it_is(disturbances):
    """Only the cart tells the arm's inertia from the motor's constant, and it moves by a tenth of a millimetre.

    The likelihood changes by less than 1 from half of the truth to four times it. Steps of dry friction made differences along
    single parameters look like information, and so did the noise that counted as known: 8.2e-5 +- 5e-7 from one start, 6.7e-5
    +- 3e-7 from another.
    """
    model, data = held_by_friction(0.12, **disturbances)
    for start in (9.5e-5, 2e-4):
        found = est.prediction_error_nonlinear(
            model.with_values({"arm_inertia": start}), data, progress=False, from_model=start > 1e-4
        )
        inertia = found.parameters["arm_inertia"]
        assert 0.3 * inertia.value < inertia.std < 10 * inertia.value
        assert re.search(r"These data do not separate .*arm_inertia.* from .*known to \+-\d\d+ %", str(found))


@pytest.mark.slow
def test_what_a_cart_that_friction_holds_does_not_show_is_named():
    """Its parameters are not put on bounds because their deviations are large: an arm without inertia would diverge."""
    model, data = held_by_friction(0.03)
    with pytest.raises(NotIdentifiableError, match=r"arm_inertia, .*torque_constant, .* may be scaled together"):
        est.prediction_error_nonlinear(
            model.with_values({"arm_inertia": 2.4e-4, "cart_coulomb.level": 0.05}),
            data,
            progress=False,
            from_model=True,
        )


@pytest.mark.slow
def test_dry_friction_that_the_rig_does_not_have_ends_on_its_bound_with_a_deviation():
    """Beside a bound the likelihood is differenced to one side."""
    rig = Rig(cart_coulomb=0.0, **SHAKEN)
    data = recorded(rig, 21)
    found = est.prediction_error_nonlinear(rtac.RTAC.from_rig(data), data, progress=False).parameters
    level = found["cart_coulomb.level"]
    assert 0 <= level.value < 3 * level.std
    assert 0 < level.std < 0.1 * Rig().cart_coulomb
    for name, truth in (("spring_stiffness", rig.spring_stiffness), ("cart_viscous.coefficient", rig.cart_viscous)):
        assert abs(found[name].value - truth) < 3 * found[name].std, name


@pytest.mark.parametrize(("ahead", "behind"), [(np.nan, 1.0), (np.nan, np.nan)], ids=["to one side", "to both"])
def test_a_model_that_diverges_beside_the_estimate(ahead, behind):
    """To one side, the other tells the slope; to both, the parameter is named."""
    point, seen = _maximum_likelihood._Point, _maximum_likelihood._Seen
    at, nothing = point(np.array([1.0]), np.zeros((0, 1))), np.zeros((0, 1))

    def foreseen(there):
        value = there.shared[0]
        lost = ahead if value > 1 else behind if value < 1 else 1.0
        return seen(np.full((4, 3, 1), 2.0 * value * lost), np.ones((4, 3, 1)))

    def rows():
        ends = (point(np.array([end]), nothing) for end in (-np.inf, np.inf))
        return _maximum_likelihood._rows(foreseen, at, point(np.array([[0.1]]), nothing), *ends, ("spring_stiffness",))

    if np.isfinite(behind):
        found = rows()[0]
        assert found.T @ found == pytest.approx(np.array([[48.0, 48.0], [48.0, 48.0 + 54.0]]))
        return
    with pytest.raises(DivergedError, match=r"beside the estimate, when spring_stiffness is changed by 0\.1; fix it"):
        rows()
