"""Candidates held against innovations: one model for all of them, or a few smaller ones."""

import numpy as np
import pytest
from hidden_effects import recorded

import estimators as est
import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis import innovation_tests
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.innovation_tests import grouped, run_tests
from estimators.diagnosis.setting import setting_of
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
def test_smaller_models_give_the_same_scores_as_one_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded({"cubic": {"cubic_spring": 5e4}}, first=40)["cubic"]
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [CATALOGUE[i] for i in CANDIDATES], Progress("diagnose", show=False))
    base = fit_base(setting)
    found = []
    for many, groups in ((np.inf, 1), (0, 4)):
        monkeypatch.setattr(innovation_tests, "_MANY", many)
        assert len(grouped(setting, ())) == groups
        screened = run_tests(setting, base).screened
        found.append({(s.id, str(s.instance)): s for s in screened})
        # Of all shapes of a candidate, the templates of the largest are kept, whatever part it was in.
        best = by_statistic(screened)
        assert all((len(s.templates) > 0) == (s is best[s.id]) for s in screened)
        assert len(screened) > len(best)
    one, several = found
    assert one.keys() == several.keys()
    assert {name for name, _ in one} == set(CANDIDATES)
    assert max(s.statistic for s in one.values()) > 100  # something is there to be told apart
    for key, s in one.items():
        np.testing.assert_allclose(several[key].statistic, s.statistic, rtol=1e-6, atol=1e-6, err_msg=str(key))
        np.testing.assert_allclose(several[key].begin, s.begin, rtol=1e-6, atol=1e-9, err_msg=str(key))
