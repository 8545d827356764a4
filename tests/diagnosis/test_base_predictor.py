"""The base model's predictor begins where the fit ended, or in closed form where that ran away; on made-up fits."""

from typing import Any

import numpy as np
import pytest

from estimators.diagnosis import base_predictor
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.setting import Setting
from rtac_jax import RTAC

FITTED = Refit.__new__(Refit)


def test_where_the_fit_ran_away_the_base_begins_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    setting = Setting.__new__(Setting)
    setting.recording = None  # type: ignore[assignment]
    begun = []

    def fits(where: Any, added: Any, model: RTAC, *_: Any) -> Refit:
        begun.append(float(np.asarray(model["arm_inertia"])))
        if begun[-1] > 1.0:
            raise FloatingPointError("diverges")
        return FITTED

    start = RTAC.paper().with_values({"arm_inertia": 2e-4})
    monkeypatch.setattr(base_predictor, "starting_values", lambda model, recording: start)
    monkeypatch.setattr(base_predictor, "fitted", fits)
    setting.colours = {}
    setting.model = RTAC.paper().with_values({"arm_inertia": 40.0})
    assert base_predictor.fit_base(setting) is FITTED
    assert begun == [40.0, 2e-4]
