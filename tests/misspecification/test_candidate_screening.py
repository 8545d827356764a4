"""Candidates held against innovations: one model for all of them, or a few smaller ones."""

from collections.abc import Sequence

import numpy as np
import pytest
from hidden_effects import recorded

import estimators as est
import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis import innovation_tests, shared_structure
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.candidate_groups import CandidateGroup, candidate_groups
from estimators.diagnosis.innovation_tests import run_tests
from estimators.diagnosis.setting import Setting, model_with, setting_of
from estimators.misspecification.candidate_screening import by_statistic
from rtac_jax.effects import CATALOGUE

CANDIDATES = (
    "cubic_spring",
    "cart_stribeck",
    "hysteretic_spring",
    "current_lag",
    "lvdt_lag",
    "saturation",
    "input_hold",
)


@pytest.mark.slow
def test_smaller_models_of_few_and_of_many_samples_give_the_same_scores_as_one_for_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = recorded({"cubic": {"cubic_spring": 5e4}}, first=40)["cubic"]
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [CATALOGUE[i] for i in CANDIDATES], Progress("diagnose", show=False))
    base = fit_base(setting)
    found = []

    def all_in_one(setting: Setting, added: Sequence[str]) -> list[CandidateGroup]:
        groups = candidate_groups(setting, added)
        return (
            [CandidateGroup(list(setting.absent), model_with(setting, list(setting.absent.values())))] if groups else []
        )

    for split, most in ((all_in_one, 1 << 30), (candidate_groups, 1 << 30), (candidate_groups, 0)):
        monkeypatch.setattr(innovation_tests, "candidate_groups", split)
        monkeypatch.setattr(shared_structure, "_MOST", most)
        screened = run_tests(setting, base).screened
        found.append({(s.id, str(s.instance)): s for s in screened})
        # Of all shapes of a candidate, the templates of the largest are kept, whatever part it was in.
        best = by_statistic(screened)
        assert all((len(s.templates) > 0) == (s is best[s.id]) for s in screened)
        assert len(screened) > len(best)
    one, *smaller = found
    assert all(one.keys() == several.keys() for several in smaller)
    assert {name for name, _ in one} == set(CANDIDATES)
    assert max(s.statistic for s in one.values()) > 100  # something is there to be told apart
    for several in smaller:
        for key, s in one.items():
            np.testing.assert_allclose(several[key].statistic, s.statistic, rtol=1e-6, atol=1e-6, err_msg=str(key))
            np.testing.assert_allclose(several[key].begin, s.begin, rtol=1e-6, atol=1e-9, err_msg=str(key))
