"""Which refit is chosen, which are its rivals, and what is found late; on made-up gains."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from known_search import Known, force, known, screened, sized

from estimators.diagnosis import candidate_results
from estimators.diagnosis.choice import chosen
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.step import Step
from estimators.diagnosis.stepwise_selection import Selection, hidden, improvements
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
    ("larger", "gain", "named"),
    [
        ("arm_stribeck", 1004.0, "arm_coulomb"),
        ("arm_stribeck", 1006.0, "arm_coulomb"),  # gains more by BIC, too little to be told from the simpler
        ("arm_presliding", 1004.0, "arm_coulomb"),  # of as many parameters
        ("arm_presliding", 1006.0, "arm_presliding"),
    ],
)
def test_a_law_is_no_rival_of_the_simpler_one_that_it_contains(larger: str, gain: float, named: str) -> None:
    search = Known(known(base=0.0, arm_coulomb=1000.0, **{larger: gain}))
    found = step(search, (), [larger, "arm_coulomb"])
    assert found is not None
    assert (found.id, found.rivals) == (named, ())


@pytest.mark.parametrize(("angle", "named"), [(1.1e-5, "arm_coulomb"), (1e-4, "arm_presliding")])
def test_bristles_that_yield_within_a_tenth_of_the_noise_are_dry_friction(angle: float, named: str) -> None:
    """Of an encoder of 8,192 counts a turn, whose rounding is 2.2e-4 rad rms: nothing that it shows is bent so little."""
    search = Known(known(base=0.0, arm_coulomb=1000.0, arm_presliding=1060.0))
    search.values = {"arm_presliding.angle": (angle, 4e-7)}
    search.facts = dataclasses.replace(search.facts, noise={"arm_angle": 2.2e-4})
    found = step(search, (), ["arm_presliding", "arm_coulomb"])
    assert found is not None
    assert found.id == named


@pytest.mark.parametrize(("lag", "rivals"), [(996.0, ("lvdt_lag",)), (994.0, ())])
def test_a_rival_is_what_bic_does_not_tell_from_the_best(lag: float, rivals: tuple[str, ...]) -> None:
    """Ten, in twice the log-likelihood."""
    found = step(Known(known(base=0.0, cubic_spring=1000.0, lvdt_lag=lag)), (), ["cubic_spring", "lvdt_lag"])
    assert found is not None
    assert (found.id, found.rivals) == ("cubic_spring", rivals)


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
    search = Known(known(base=0.0, arm_coulomb=950.0, arm_stribeck=980.0, arm_coulomb__arm_stribeck=990.0))
    search.values = {"arm_coulomb.size": (coulomb, std), "arm_stribeck.size": (1e-3, 1e-4)}
    scores = (sized("arm_stribeck", 900.0, 1e-15), sized("arm_coulomb", 850.0, 1e-15))
    search.rejects = lambda model: Findings(scores[:1] if model.added == ("arm_coulomb",) else ())
    found, _ = improvements(search, search.base, Findings(scores, FORCE.curves), STANDARD)
    assert [s.id for s in found] == names
    assert [s.rivals for s in found] == [()] * len(names)
    assert found[-1].gain == pytest.approx(1960.0 if len(names) == 1 else 80.0)


@pytest.mark.parametrize("shown", [77.0, -5.0])
def test_a_gain_of_the_sensor_is_held_against_a_wrong_constant_though_its_score_hides_it(shown: float) -> None:
    search = Known(known(base=0.0, wrong_arm_inertia=760.0, lvdt_gain=759.0))
    scores = (sized("wrong_arm_inertia", 540.0, 1e-40), sized("lvdt_gain", shown, 0.8))
    search.rejects = lambda model: Findings()
    found, _ = improvements(search, search.base, Findings(scores, FORCE.curves), STANDARD)
    assert [(s.id, s.rivals) for s in found] == [("wrong_arm_inertia", ("lvdt_gain",))]


def test_what_presupposes_an_effect_in_the_model_is_tried_though_it_scatters() -> None:
    search = Known(known(base=0.0, arm_coulomb=950.0, arm_stribeck=980.0, arm_coulomb__arm_stribeck=1100.0))
    search.values = {"arm_coulomb.size": (1e-3, 1e-5), "arm_stribeck.size": (1e-3, 1e-4)}
    scattered = (sized("arm_coulomb", 400.0, 0.5), sized("arm_stribeck", 900.0, 0.5))
    search.rejects = lambda model: Findings(scattered[1:], FORCE.curves if len(model.added) < 2 else ())
    alarming = dataclasses.replace(scattered[1], p_value=1e-15)
    found, _ = improvements(search, search.base, Findings((scattered[0], alarming), FORCE.curves), STANDARD)
    assert [s.id for s in found] == ["arm_coulomb", "arm_stribeck"]


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


QUIET = (
    ("end_stop", 9000.0, 0.4), ("lvdt_gain", 8000.0, 0.3), ("arm_coulomb", 7000.0, 1e-4), ("lvdt_lag", 600.0, 1e-5),
    ("backlash", 500.0, 0.01), ("flexible_mode", 400.0, 0.2), ("flexible_shaft", 300.0, 0.05), ("saturation", 200.0, 0.5),
)  # fmt: skip


def test_what_random_forces_hide_is_tried_in_this_order() -> None:
    """First what is most alike in every second, then what is largest, then what works by contact."""
    search = Late(known(base=0.0))
    search.quiet = QUIET
    look = hidden(search, selected(search, FORCE), STANDARD)
    assert [s.id for s in look.ranked] == ["lvdt_lag", "end_stop", "backlash"]
    assert list(look.near) == []
    # What could not be shown at all beside random forces that stand for it is what they hide; the largest of it comes too.
    search.facts = dataclasses.replace(search.facts, untestable=("end_stop",))
    assert [s.id for s in hidden(search, selected(search, FORCE), STANDARD).ranked] == [
        "lvdt_lag",
        "end_stop",
        "backlash",
    ]
    search.facts = dataclasses.replace(search.facts, untestable=("saturation", "flexible_shaft"))
    ranked = [s.id for s in hidden(search, selected(search, FORCE), STANDARD).ranked]
    assert ranked == ["lvdt_lag", "end_stop", "backlash", "flexible_shaft"]


def test_what_works_by_contact_is_tried_however_little_it_shows() -> None:
    search = Late(known(base=0.0))
    search.quiet = (*(one for one in QUIET if one[0] != "backlash"), ("backlash", 1.0, 1.0))
    look = hidden(search, selected(search, FORCE), STANDARD)
    ranked = [s.id for s in look.ranked]
    assert ranked == ["lvdt_lag", "end_stop", "backlash"]


def test_what_overshadows_the_alarms_is_chosen_where_it_gains_most() -> None:
    search = Late(known(base=0.0, arm_coulomb=500.0, lvdt_lag=1000.0))
    search.line = 30.0
    scores = (sized("arm_coulomb", 400.0, 1e-15), sized("lvdt_lag", 900.0, 0.1))
    steps, _ = improvements(search, search.base, Findings(scores, (force(2000.0),)), STANDARD)
    assert steps[0].id == "lvdt_lag"


@pytest.mark.parametrize(("angle", "named"), [(1.5e-5, "arm_coulomb"), (1e-3, "arm_presliding")])
def test_bristles_that_yield_within_the_first_sample_are_dry_friction(angle: float, named: str) -> None:
    """Though they fit better by far, and nobody measured the angle: the rms torque moves the arm by 1.9e-4 rad in a sample."""
    search = Known(known(base=-1000.0, arm_coulomb=-900.0, arm_presliding=-800.0))
    search.facts = dataclasses.replace(search.facts, travel={"arm_angle": 1.9e-4})
    search.values = {"arm_presliding.angle": (angle, 5e-7)}
    tried = {name: (screened(name), search.model(name)) for name in ("arm_coulomb", "arm_presliding")}
    found = chosen(search, search.base, tried, STANDARD)
    assert found is not None
    assert found.id == named
    search.facts = dataclasses.replace(search.facts, travel={})
    assert (other := chosen(search, search.base, tried, STANDARD)) is not None
    assert other.id == "arm_presliding"  # as in evidence of an earlier version, which does not know it


@pytest.mark.parametrize(("excess", "avoidable"), [(0.0, False), (400.0, True)])
def test_where_nothing_rejects_there_is_nothing_to_explain(excess: float, avoidable: bool) -> None:
    """A refit that gains next to nothing explained 100 % of that."""
    search = Known(known(base=0.0, backlash=6.0))
    tests = adequacy_tests(Findings((), (force(excess),) if excess else ()), STANDARD.critical)
    assert any(test.rejects for test in tests) == avoidable
    selection = Selection(search.base, Findings(), tests, [], {"backlash": (search.base, search.model("backlash"))})
    assert (candidate_results._most(selection, 10_000) > 0) == avoidable
