"""Candidates are simulated in groups of what is as dear, and an effect that is added changes as few models as may be."""

import dataclasses

import jax
import pytest

import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis import shared_structure
from estimators.diagnosis.candidate_groups import candidate_groups, model_alone, model_beside
from estimators.diagnosis.setting import Setting, set_up
from rtac_jax.effects import ArmCoulomb, CubicSpring, FlexibleMode, ForceOffset, InputDelay, InputHold, LvdtLag
from rtac_jax.simulation import equations_of
from rtac_jax.virtual_rig import Rig, record, standard_plans

SIMPLE, DEAR, INPUTS = (
    {"cubic_spring", "force_offset"},
    {"arm_coulomb", "lvdt_lag", "flexible_mode"},
    {"input_delay", "input_hold"},
)


@pytest.fixture(scope="module")
def setting() -> Setting:
    recording = record(Rig(), standard_plans(seed=3, duration=1.0, free=1, forced=1), seed=4, step=1e-3)
    classes = [CubicSpring, ForceOffset, ArmCoulomb, LvdtLag, FlexibleMode, InputDelay, InputHold]
    return set_up(rtac.RTAC.from_rig(recording), recording, classes, {}, 4, Progress("test", show=False))


def structures(setting: Setting, *added: str) -> list[object]:
    return [jax.tree.structure(equations_of(group.model)) for group in candidate_groups(setting, added)]


@pytest.mark.parametrize("short", [True, False])
@pytest.mark.parametrize(
    "added", [(), ("cubic_spring",), ("arm_coulomb",), ("input_delay",), ("cubic_spring", "lvdt_lag")]
)
def test_every_candidate_left_is_in_one_group_whose_model_has_it_and_what_was_added(
    setting: Setting, added: tuple[str, ...], short: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not short:
        monkeypatch.setattr(shared_structure, "_MOST", 0)
    groups = candidate_groups(setting, added)
    assert sorted(i for group in groups for i in group.ids) == sorted(set(setting.absent) - set(added))
    for group in groups:
        assert {*group.ids, *added} <= set(group.model.ids)
        if not short:
            assert set(group.model.ids) == {*group.ids, *added, *setting.model.ids}
        # Inputs cost as much as all others together.
        assert set(group.ids) <= INPUTS or not set(group.model.ids) & INPUTS - set(added)


def test_what_is_simple_is_by_itself_unless_what_was_added_is_not(setting: Setting) -> None:
    assert [set(group.ids) for group in candidate_groups(setting, ())] == [DEAR, SIMPLE, INPUTS]
    assert set(candidate_groups(setting, ())[1].model.ids) == SIMPLE | set(setting.model.ids)
    assert [set(group.ids) for group in candidate_groups(setting, ("lvdt_lag",))] == [
        (DEAR | SIMPLE) - {"lvdt_lag"},
        INPUTS,
    ]


def test_of_few_samples_a_simple_effect_that_is_added_changes_no_model(setting: Setting) -> None:
    assert structures(setting) == structures(setting, "cubic_spring")
    assert structures(setting)[0] == structures(setting, "arm_coulomb")[0]
    mended = dataclasses.replace(
        setting,
        model=setting.model + CubicSpring(1e4),
        absent={i: e for i, e in setting.absent.items() if i != "cubic_spring"},
    )
    assert structures(setting) == structures(mended), "so the next diagnosis of a loop compiles none"


def test_alone_and_beside(setting: Setting) -> None:
    assert set(model_alone(setting, ("lvdt_lag",)).ids) == {"lvdt_lag", *setting.model.ids}
    assert set(model_alone(setting, ("cubic_spring",)).ids) == SIMPLE | set(setting.model.ids)
    assert set(model_beside(setting, ("lvdt_lag",), "input_hold").ids) == {"lvdt_lag", "input_hold", *setting.model.ids}
