"""Refits with simple candidates share one structure, and end as they do each in its own."""

import dataclasses
from typing import Any

import jax
import made_up_results
import numpy as np
import pytest

import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis import shared_structure
from estimators.diagnosis.innovation_tests import run_tests
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import fitted
from estimators.diagnosis.setting import Setting, model_with, set_up, shared, space_for
from estimators.diagnosis.shared_structure import is_simple, probed_model, run_model, with_absent, without_absent
from estimators.prediction_error.filter_pass import _arguments, _filter
from estimators.prediction_error.noise_estimation import first_noise
from rtac_jax.effects import CATALOGUE, ArmCoulomb, CubicSpring, FlexibleMode, ForceOffset, InputDelay, LvdtLag
from rtac_jax.parameters import declarations
from rtac_jax.simulation import equations_of
from rtac_jax.virtual_rig import Rig, record, standard_plans


@pytest.fixture(scope="module")
def setting() -> Setting:
    """A rig with a cubic spring, in two short runs."""
    recording = record(Rig(cubic_spring=3e5), standard_plans(seed=3, duration=2.0, free=1, forced=1), seed=4, step=5e-4)
    classes = [CubicSpring, ForceOffset, ArmCoulomb, LvdtLag, FlexibleMode, InputDelay]
    return set_up(rtac.RTAC.from_rig(recording), recording, classes, {}, 4, Progress("test", show=False))


def refitted(setting: Setting, *effects: str) -> Refit:
    model = model_with(setting, [setting.absent[i] for i in setting.absent if i in effects])
    model = model.with_values({"cubic_spring.stiffness": 1e5} if "cubic_spring" in effects else {})
    free = (*shared(setting.model), *(n for n in model.free if n.split(".")[0] in effects))
    return fitted(setting, effects, model, free, None, {})


def test_what_has_no_states_and_no_threshold_is_simple() -> None:
    shapes = {i: {n: 1.0 for n, d in declarations(c).items() if d.null is None} for i, c in CATALOGUE.items()}
    simple = {i for i, c in CATALOGUE.items() if is_simple(c.absent(**shapes[i]))}
    assert {"cubic_spring", "force_offset", "cogging", "lvdt_gain", "saturation"} <= simple
    assert not simple & {"arm_coulomb", "cart_stribeck", "lvdt_lag", "flexible_mode", "backlash", "input_delay"}

    class Own(CubicSpring):
        """Of a user, who says by the same name what else it does."""

    assert not is_simple(Own(0.0))


@pytest.mark.slow
def test_a_refit_in_the_shared_structure_is_that_in_its_own(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    common = run_model(setting, ("cubic_spring",))
    assert common is not None
    assert {"cubic_spring", "force_offset"} <= set(common.ids)
    assert "arm_coulomb" not in common
    together = refitted(setting, "cubic_spring")
    compiled = _filter.compiled
    beside = refitted(setting, "force_offset")
    assert _filter.compiled == compiled, "one filter serves both"
    monkeypatch.setattr(shared_structure, "_MOST", 0)
    assert run_model(setting, ("cubic_spring",)) is None
    for one, names in ((together, ("cubic_spring",)), (beside, ("force_offset",))):
        alone = refitted(setting, *names)
        assert one.predictor.log_likelihood == pytest.approx(alone.predictor.log_likelihood, abs=1e-4)
        assert one.space.names == alone.space.names
        assert one.free == alone.free
        assert one.triangles.shape == alone.triangles.shape
        known = np.sqrt(np.sum(alone.triangles[:, :, : len(alone.free)] ** 2, axis=(0, 1)))
        for mine, its, told in zip(
            np.asarray(one.predictor.unknowns.shared), np.asarray(alone.predictor.unknowns.shared), known, strict=True
        ):
            assert abs(mine - its) * told < 0.02, "within a fiftieth of what the data tell"
        np.testing.assert_allclose(one.by_sample, alone.by_sample, atol=1e-3)


def test_simulations_with_simple_candidates_are_of_one_structure(setting: Setting) -> None:
    several = [setting.model + effect for effect in (CubicSpring(1e5), ForceOffset(1e-3))]
    wider = [with_absent(setting, model) for model in several]
    first, second = (jax.tree.structure(equations_of(model)) for model in wider if model is not None)
    assert first == second
    assert with_absent(setting, setting.model + ArmCoulomb(1e-4)) is None
    for model, wide in zip(several, wider, strict=True):
        assert wide is not None
        assert wide.free == model.free
        fit = dataclasses.replace(made_up_results.FIT, model=wide)
        assert without_absent(fit, model).model.values == model.values


@pytest.mark.parametrize("added", [(), ("arm_coulomb",), ("cubic_spring", "lvdt_lag"), ("flexible_mode",)])
def test_others_have_their_own(setting: Setting, added: Any) -> None:
    assert run_model(setting, added) is None


def test_of_a_part_the_base_model_has_it_too(setting: Setting) -> None:
    part = dataclasses.replace(setting, part=True)
    assert run_model(part, ()) is not None
    assert run_model(part, ("flexible_mode",)) is None


def test_derivatives_of_all_simple_models_are_of_it_but_not_of_a_base_model_with_states(setting: Setting) -> None:
    several = [probed_model(setting, added) for added in ((), ("cubic_spring",), ("force_offset", "cubic_spring"))]
    assert len({jax.tree.structure(equations_of(model)) for model in several if model is not None}) == 1
    assert None not in several
    assert probed_model(setting, ("flexible_mode",)) is None
    mode = setting.model + FlexibleMode(0.1, 60.0, 0.02)
    assert probed_model(dataclasses.replace(setting, model=mode), ()) is None


@pytest.mark.slow
def test_the_base_model_of_a_part_and_its_tests_end_as_in_its_own_structure(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = dataclasses.replace(setting, part=True)
    wide, alone = refitted(part), refitted(setting)
    assert wide.predictor.log_likelihood == pytest.approx(alone.predictor.log_likelihood, abs=1e-4)
    assert wide.space.names == alone.space.names
    tested = run_tests(part, wide)
    monkeypatch.setattr(shared_structure, "_MOST", 0)
    by_itself = run_tests(setting, alone)
    for one, other in zip(tested.screened, by_itself.screened, strict=True):
        assert one.id == other.id
        assert float(one.statistic) == pytest.approx(float(other.statistic), rel=1e-3, abs=1e-2)


def test_a_filter_is_one_program_whatever_is_free(setting: Setting) -> None:
    programs = set()
    for free in (["spring_stiffness"], shared(setting.model)):
        space = space_for(setting, setting.model, free)
        physical, prior = (space.values, space.each_values, space.start), setting.prior.starting(space)
        given = _arguments(setting.model, setting.data, space, physical, prior, first_noise(), setting.substeps)
        programs.add((jax.tree.structure(given), tuple(np.shape(leaf) for leaf in jax.tree.leaves(given))))
    assert len(programs) == 1
