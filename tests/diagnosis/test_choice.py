"""Which refit is chosen, what becomes of it when a later one explains the same, and what is found late; on made-up gains."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from known_search import Known, force, known, screened, sized

from estimators.diagnosis.choice import chosen, reconsidered
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.removed_error import named as named_of
from estimators.diagnosis.step import Step
from estimators.diagnosis.stepwise_selection import Selection, hidden, improvements, second_looks
from estimators.misspecification.adequacy import adequacy_tests
from estimators.misspecification.findings import Findings, Score, SpectralLine


def step(search: Known, before: Sequence[str], several: Sequence[str]) -> Step | None:
    tried = {e: (screened(e), search.model(*before, e)) for e in several}
    return chosen(search, search.model(*before), tried, search.policy)


def steps(search: Known, *rounds: Sequence[str]) -> list[Step]:
    """What a forward selection from these candidates finds."""
    found: list[Step] = []
    for several in rounds:
        one = step(search, found[-1].model.added if found else (), several)
        assert one is not None
        found.append(one)
    return found


@pytest.mark.parametrize(
    ("stribeck", "rivals"),
    [
        (1003.0, ()),  # what the spare parameter gains comes by chance
        (1004.0, ("arm_stribeck",)),  # more than by chance in one of a hundred, less than BIC asks
    ],
)
def test_an_effect_is_no_rival_of_the_simpler_one_that_it_contains(stribeck: float, rivals: tuple[str, ...]) -> None:
    search = Known(known(base=0.0, arm_coulomb=1000.0, arm_stribeck=stribeck))
    found = step(search, (), ["arm_stribeck", "arm_coulomb"])
    assert found is not None
    assert (found.id, found.rivals) == ("arm_coulomb", rivals)


@pytest.mark.parametrize(("bristles", "rivals"), [(1003.0, ()), (1004.5, ("arm_presliding",))])
def test_the_simpler_of_two_that_nothing_tells_apart_is_chosen_though_the_larger_gains_more(
    bristles: float, rivals: tuple[str, ...]
) -> None:
    search = Known(known(base=0.0, arm_coulomb=1000.0, arm_presliding=bristles))
    found = step(search, (), ["arm_presliding", "arm_coulomb"])
    assert found is not None
    assert (found.id, found.rivals) == ("arm_coulomb", rivals)


def test_a_shape_that_ran_away_is_chosen_only_where_nothing_else_helps() -> None:
    likelihood = known(base=0.0, arm_coulomb=900.0, arm_stribeck=1000.0, cubic_spring=1.0)
    for others, expected in ((["arm_coulomb"], "arm_coulomb"), (["cubic_spring"], "arm_stribeck")):
        found = step(Known(likelihood, loose=["arm_stribeck"]), (), ["arm_stribeck", *others])
        assert found is not None
        assert found.id == expected
    assert step(Known(likelihood), (), ["cubic_spring"]) is None


def test_what_does_not_help_where_it_was_not_estimated_is_not_chosen() -> None:
    likelihood = known(base=0.0, arm_coulomb=900.0, lvdt_lag=1000.0, cubic_spring=300.0)
    search = Known(likelihood, held_out={"lvdt_lag": -1.0, "arm_coulomb": 0.0})
    found = step(search, (), ["lvdt_lag", "arm_coulomb", "cubic_spring"])
    assert found is not None
    assert (found.id, found.rivals) == ("cubic_spring", ())
    assert step(search, (), ["lvdt_lag", "arm_coulomb"]) is None


def test_where_one_experiment_only_shows_an_effect_no_other_can_refuse_it() -> None:
    found = step(Known(known(base=0.0, lvdt_lag=1000.0), held_out={"lvdt_lag": np.nan}), (), ["lvdt_lag"])
    assert found is not None
    assert found.id == "lvdt_lag"


def test_an_effect_gives_way_to_the_one_that_it_stood_for() -> None:
    """Bristles mend a part of what the lag does, until the lag is in the model."""
    search = Known(
        known(
            base=0.0, arm_presliding=500.0, arm_coulomb=450.0, lvdt_lag=300.0, arm_presliding__lvdt_lag=900.0,
            arm_coulomb__lvdt_lag=1000.0,
        )
    )  # fmt: skip
    before = steps(search, ["arm_presliding", "arm_coulomb"], ["lvdt_lag"])
    assert [s.id for s in before] == ["arm_presliding", "lvdt_lag"]
    after = reconsidered(search, search.model(), before, STANDARD)
    assert [s.id for s in after] == ["lvdt_lag", "arm_coulomb"]
    assert [s.gain for s in after] == pytest.approx([600.0, 1400.0])
    assert after[-1].model.added == ("lvdt_lag", "arm_coulomb")


@pytest.mark.parametrize(
    ("coulomb", "std", "names"),
    [
        (5e-5, 1e-5, ["arm_stribeck"]),  # ruled out: 7e-5 is less than a tenth of 1e-3
        (5e-5, 3e-5, ["arm_coulomb", "arm_stribeck"]),  # it may be 1.1e-4
        (5e-4, 1e-5, ["arm_coulomb", "arm_stribeck"]),
    ],
)
def test_before_a_law_comes_what_it_presupposes_unless_the_data_rule_that_out(
    coulomb: float, std: float, names: list[str]
) -> None:
    """Stribeck friction explains more than Coulomb's, which adds next to nothing to it."""
    search = Known(known(base=0.0, arm_coulomb=950.0, arm_stribeck=980.0, arm_coulomb__arm_stribeck=981.0))
    search.values = {"arm_coulomb.size": (coulomb, std), "arm_stribeck.size": (1e-3, 1e-4)}
    before = steps(search, ["arm_stribeck", "arm_coulomb"], ["arm_stribeck"])
    assert [s.id for s in before] == ["arm_coulomb", "arm_stribeck"]
    assert [s.rivals for s in before] == [(), ()]
    assert [s.id for s in reconsidered(search, search.model(), before, STANDARD)] == names


def test_what_presupposes_an_effect_in_the_model_is_tried_though_it_scatters() -> None:
    search = Known(known(base=0.0, arm_coulomb=950.0, arm_stribeck=980.0, arm_coulomb__arm_stribeck=1100.0))
    search.values = {"arm_coulomb.size": (1e-3, 1e-5), "arm_stribeck.size": (1e-3, 1e-4)}
    scattered = (sized("arm_coulomb", 400.0, 0.5), sized("arm_stribeck", 900.0, 0.5))
    search.rejects = lambda model: Findings(scattered[1:], FORCE.curves if len(model.added) < 2 else ())
    alarming = dataclasses.replace(scattered[1], p_value=1e-15)
    found, _ = improvements(search, search.base, Findings((scattered[0], alarming), FORCE.curves), STANDARD)
    assert [s.id for s in found] == ["arm_coulomb", "arm_stribeck"]


def test_an_effect_that_is_not_needed_any_more_goes() -> None:
    search = Known(known(base=0.0, arm_coulomb=100.0, lvdt_lag=898.0, arm_coulomb__lvdt_lag=900.0))
    after = reconsidered(search, search.model(), steps(search, ["arm_coulomb"], ["lvdt_lag"]), STANDARD)
    assert [(s.id, s.gain) for s in after] == [("lvdt_lag", pytest.approx(1796.0))]


def test_what_is_needed_stays_and_a_rival_of_the_first_round_is_told_from_it() -> None:
    likelihood = known(base=0.0, cubic_spring=500.0, arm_coulomb=498.0, lvdt_lag=300.0)
    likelihood |= known(cubic_spring__lvdt_lag=1000.0, arm_coulomb__lvdt_lag=600.0)
    search = Known(likelihood)
    before = steps(search, ["cubic_spring", "arm_coulomb"], ["lvdt_lag"])
    assert before[0].rivals == ("arm_coulomb",)
    after = reconsidered(search, search.model(), before, STANDARD)
    assert [s.id for s in after] == ["cubic_spring", "lvdt_lag"]
    assert after[0].rivals == ()


def test_what_the_model_diverges_without_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    search = Known(known(base=0.0, arm_coulomb=100.0, lvdt_lag=898.0, arm_coulomb__lvdt_lag=900.0))
    before = steps(search, ["arm_coulomb"], ["lvdt_lag"])

    monkeypatch.setattr(search, "without", lambda model, effect: None)
    after = reconsidered(search, search.model(), before, STANDARD)
    assert [s.id for s in after] == ["arm_coulomb", "lvdt_lag"]


class Late(Known):
    """One in which every refit leaves a spectral line, and all candidates but some are seen by a quiet predictor only."""

    line = 0.0
    quiet: tuple[tuple[str, float, float], ...] = (("cubic_spring", 900.0, 1.0),)

    def findings(self, model: FittedModel) -> Findings:
        return Findings(line=line(self.line))

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        return tuple(sized(*one) for one in self.quiet)


def line(excess: float) -> SpectralLine:
    return SpectralLine("arm_velocity", 100.0, 10.0, excess, 1e-9 if excess else 1.0)


FORCE = Findings(curves=(force(2000.0),))


def selected(search: Known, findings: Findings, steps: Sequence[Step] = ()) -> Selection:
    tests = adequacy_tests(findings, STANDARD.critical)
    return Selection(search.base, findings, tests, list(steps), {})


@pytest.mark.parametrize(("line", "named"), [(0.0, 1), (30.0, 1), (60.0, 0)])
def test_a_late_find_may_leave_a_small_line_only(line: float, named: int) -> None:
    """Of a gain of 2000, in units of twice the log-likelihood, 40 are a fiftieth."""
    search = Late(known(base=0.0, cubic_spring=1000.0))
    search.line = line
    found = second_looks(search, selected(search, FORCE), STANDARD)
    assert named_of(found.steps, found.tests, search.facts.samples, STANDARD)[1] == named
    assert set(found.tried) == {"cubic_spring"}


QUIET = (
    ("end_stop", 9000.0, 0.4), ("lvdt_gain", 8000.0, 0.3), ("arm_coulomb", 7000.0, 1e-4), ("lvdt_lag", 600.0, 1e-5),
    ("backlash", 500.0, 0.01), ("flexible_mode", 400.0, 0.2), ("flexible_shaft", 300.0, 0.05), ("saturation", 200.0, 0.5),
)  # fmt: skip


@pytest.mark.parametrize(
    ("excess", "ranked", "near"),
    [
        # By p-value, of which the first two are near each other, and then what is largest.
        (1999.0, ["lvdt_lag", "arm_coulomb", "backlash", "end_stop", "lvdt_gain"], ["arm_coulomb"]),
        # A line that is more than all else is of what has a resonance, which a play has not.
        (
            2001.0,
            ["flexible_shaft", "flexible_mode", "lvdt_lag", "arm_coulomb", "backlash", "end_stop", "lvdt_gain"],
            ["flexible_mode", "lvdt_lag", "arm_coulomb"],
        ),
    ],
)
def test_what_random_forces_hide_is_tried_in_this_order(excess: float, ranked: list[str], near: list[str]) -> None:
    search = Late(known(base=0.0))
    search.quiet = QUIET
    look = hidden(search, selected(search, Findings(curves=(force(2000.0),), line=line(excess))), STANDARD)
    assert [s.id for s in look.ranked] == ranked
    assert [s.id for s in look.near] == near


def test_what_works_by_contact_is_tried_however_little_it_shows() -> None:
    search = Late(known(base=0.0))
    search.quiet = (*(one for one in QUIET if one[0] != "backlash"), ("backlash", 1.0, 1.0))
    look = hidden(search, selected(search, FORCE), STANDARD)
    ranked = [s.id for s in look.ranked]
    assert ranked == ["lvdt_lag", "arm_coulomb", "flexible_shaft", "end_stop", "lvdt_gain", "backlash"]


@pytest.mark.parametrize(("line", "first"), [(30.0, "lvdt_lag"), (60.0, "arm_coulomb")])
def test_what_overshadows_the_alarms_is_chosen_where_it_gains_most_and_leaves_no_large_line(
    line: float, first: str
) -> None:
    search = Late(known(base=0.0, arm_coulomb=500.0, lvdt_lag=1000.0))
    search.line = line
    scores = (sized("arm_coulomb", 400.0, 1e-15), sized("lvdt_lag", 900.0, 0.1))
    steps, _ = improvements(search, search.base, Findings(scores, (force(2000.0),)), STANDARD)
    assert steps[0].id == first
