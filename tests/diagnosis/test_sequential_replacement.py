"""An effect that was selected while others were missing gives way to what does better beside them."""

import dataclasses

import pytest
from known_search import Known, known, sized

from estimators.diagnosis.evidence import EffectTraits
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import _Look, improvements
from estimators.misspecification.findings import Findings

FIRST = ("gravity_tilt", "lvdt_offset", "force_offset")
# A tilt takes a part of a ripple as long as that is missing.
TILT = known(
    base=-10_000.0, gravity_tilt=-5000.0, lvdt_offset=-5050.0, force_offset=-5060.0, gravity_tilt__tacho_ripple=-2000.0,
    lvdt_offset__tacho_ripple=-1990.0, force_offset__tacho_ripple=-1992.0,
)  # fmt: skip


class Search(Known):
    """A laboratory in which three effects show first, and beside any of them a ripple; it notes what is refitted."""

    def __init__(self, likelihood, first=FIRST, second="tacho_ripple", left=None, unanswered=(), **options):
        super().__init__(likelihood, **options)
        self.asked, self.unanswered = [], unanswered
        self.left = left or {}

        def seen(model):
            if second in model.added:
                left = self.left.get(model.added[0], 0.0)
                return Findings((sized("cogging", left, 1e-9),) if left else ())
            if model.added:
                return Findings((sized(second, 900.0, 1e-9),))
            return Findings(tuple(sized(effect, 1000.0 - place, 1e-9) for place, effect in enumerate(first)))

        self.rejects = seen

    def refits(self, before, several, way):
        self.asked += [(*before.added, score.id) for score in several]
        return super().refits(before, [s for s in several if (*before.added, s.id) not in self.unanswered], way)


def selected(search):
    steps, _ = improvements(search, search.base, search.rejects(search.base), STANDARD)
    return {step.id: set(step.rivals) for step in steps}, steps


def test_what_was_selected_first_gives_way_and_keeps_rivals_that_nothing_tells_apart():
    found, steps = selected(Search(TILT))
    # 20 and 16 in twice the log-likelihood better than the tilt.
    assert found == {"lvdt_offset": {"force_offset"}, "tacho_ripple": set()}
    assert [step.model.added for step in steps] == [("lvdt_offset",), ("lvdt_offset", "tacho_ripple")]
    assert [step.gain for step in steps] == [2 * 4950.0, 2 * 3060.0]
    assert steps[0].amplitudes == ("size",)


@pytest.mark.parametrize(
    ("offset", "found"),
    [
        (-1996.0, {"lvdt_offset": {"gravity_tilt"}, "tacho_ripple": set()}),
        (-2003.0, {"gravity_tilt": {"lvdt_offset"}, "tacho_ripple": set()}),
        (-2030.0, {"gravity_tilt": set(), "tacho_ripple": set()}),
    ],
)
def test_the_likelier_is_named_and_the_other_a_rival_where_it_is_near(offset, found):
    likelihood = TILT | known(force_offset=-9000.0, lvdt_offset__tacho_ripple=offset)
    assert selected(Search(likelihood))[0] == found


def test_what_is_far_behind_is_not_asked_again():
    search = Search(TILT | known(lvdt_offset=-7000.0, force_offset=-7000.0))
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}
    assert not {("lvdt_offset", "tacho_ripple"), ("force_offset", "tacho_ripple")} & set(search.asked)


def test_what_leaves_more_than_the_first_did_takes_no_place():
    search = Search(TILT, left={"lvdt_offset": 60.0, "force_offset": 60.0})
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}
    assert ("lvdt_offset", "tacho_ripple") in search.asked


def test_what_is_left_with_both_speaks_against_neither():
    worthless = known(**{f"{first}__tacho_ripple__cogging": -3000.0 for first in FIRST})
    search = Search(TILT | worthless, left=dict.fromkeys(FIRST, 60.0))
    assert selected(search)[0] == {"lvdt_offset": {"force_offset"}, "tacho_ripple": set()}


def test_what_would_explain_less_takes_no_place():
    worthless = known(**{f"{first}__tacho_ripple__cogging": -3000.0 for first in FIRST})
    search = Search(TILT | worthless, left={"gravity_tilt": 60.0, "lvdt_offset": 9990.0, "force_offset": 9990.0})
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}


@pytest.mark.parametrize(
    "unanswered", [("lvdt_offset", "tacho_ripple"), None], ids=["broken off", "nothing left to refit"]
)
def test_a_rival_that_could_not_be_asked_stays_one(unanswered):
    search = Search(TILT | known(lvdt_offset=-5002.0, force_offset=-9000.0), unanswered=(unanswered,))
    if unanswered is None:
        seen = search.rejects
        search.rejects = lambda model: Findings() if model.added == ("lvdt_offset",) else seen(model)
    assert selected(search)[0] == {"gravity_tilt": {"lvdt_offset"}, "tacho_ripple": set()}


def test_what_is_replaced_is_told_by_the_refits_that_are_named():
    search = Search(TILT)
    steps, tried = improvements(search, search.base, search.rejects(search.base), STANDARD)
    assert [tried[step.id] for step in steps] == [(search.base, steps[0].model), (steps[0].model, steps[1].model)]


def test_neither_what_presupposes_another_nor_a_larger_law_comes_first():
    likelihood = known(
        base=-10_000.0, gravity_tilt=-5000.0, arm_coulomb=-5010.0, arm_stribeck=-5012.0, gravity_tilt__tacho_ripple=-2000.0,
        arm_coulomb__tacho_ripple=-1990.0, arm_stribeck__tacho_ripple=-1900.0,
    )  # fmt: skip
    search = Search(likelihood, first=("gravity_tilt", "arm_coulomb", "arm_stribeck"))
    assert selected(search)[0] == {"arm_coulomb": set(), "tacho_ripple": set()}
    likelihood = known(
        base=-10_000.0, gravity_tilt=-5000.0, cart_coulomb=-5010.0, cart_presliding=-5009.0, gravity_tilt__tacho_ripple=-2000.0,
        cart_coulomb__tacho_ripple=-1991.0, cart_presliding__tacho_ripple=-1988.0,
    )  # fmt: skip
    search = Search(likelihood, first=("gravity_tilt", "cart_coulomb", "cart_presliding"))
    assert selected(search)[0] == {"cart_coulomb": set(), "tacho_ripple": set()}


@pytest.mark.parametrize(("yields", "first"), [(1e-4, "cart_presliding"), (1e-9, "gravity_tilt")])
def test_bristles_that_yield_by_less_than_a_sensor_shows_take_no_place(yields, first):
    likelihood = known(
        base=-10_000.0, gravity_tilt=-5000.0, cart_presliding=-5010.0, gravity_tilt__tacho_ripple=-2000.0,
        cart_presliding__tacho_ripple=-1980.0,
    )  # fmt: skip
    search = Search(likelihood, first=("gravity_tilt", "cart_presliding"))
    search.facts = dataclasses.replace(search.facts, noise={"cart_position": 1e-5})
    search.values |= {"cart_presliding.displacement": (yields, 0.0)}
    assert next(iter(selected(search)[0])) == first
    assert (("cart_presliding", "tacho_ripple") in search.asked) == (first == "cart_presliding")


def test_what_presupposes_an_effect_that_nobody_selected_takes_no_place():
    likelihood = known(
        base=-10_000.0, gravity_tilt=-5000.0, arm_stribeck=-5010.0, gravity_tilt__tacho_ripple=-2000.0,
        arm_stribeck__tacho_ripple=-1900.0,
    )  # fmt: skip
    search = Search(likelihood, first=("gravity_tilt", "arm_stribeck"))
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}
    assert ("arm_stribeck", "tacho_ripple") not in search.asked


def test_a_simpler_law_that_the_first_contains_takes_no_place():
    likelihood = known(
        base=-10_000.0, cart_presliding=-5000.0, cart_coulomb=-5060.0, cart_presliding__tacho_ripple=-2000.0,
        cart_coulomb__tacho_ripple=-1900.0,
    )  # fmt: skip
    search = Search(likelihood, first=("cart_presliding", "cart_coulomb"))
    assert selected(search)[0] == {"cart_presliding": set(), "tacho_ripple": set()}
    assert ("cart_coulomb", "tacho_ripple") not in search.asked


@pytest.mark.parametrize(("yields", "first"), [(1e-4, "cart_presliding"), (5e-7, "cart_coulomb")])
def test_what_beside_the_later_effects_has_become_a_simpler_law_gives_way_to_it(yields, first):
    """The bristles took a part of the ripple while that was missing, and more of the likelihood."""
    likelihood = known(
        base=-10_000.0, cart_presliding=-5000.0, cart_coulomb=-5060.0, cart_presliding__tacho_ripple=-2000.0,
        cart_coulomb__tacho_ripple=-2030.0,
    )  # fmt: skip
    search = Search(likelihood, first=("cart_presliding", "cart_coulomb"))
    search.facts = dataclasses.replace(search.facts, noise={"cart_position": 1e-5})
    beside = {"cart_presliding": 1e-4, "cart_presliding__tacho_ripple": yields}
    model = search.model
    search.model = lambda *ids: dataclasses.replace(
        model(*ids),
        values={**model(*ids).values, "cart_presliding.displacement": (beside.get("__".join(ids), 1e-4), 0.0)},
    )
    assert selected(search)[0] == {first: set(), "tacho_ripple": set()}


def test_where_the_later_effect_gains_too_little_beside_it_a_candidate_is_no_rival():
    likelihood = known(
        base=-10_000.0, gravity_tilt=-5000.0, lvdt_offset=-5000.5, gravity_tilt__tacho_ripple=-4988.0,
        lvdt_offset__tacho_ripple=-4991.5,
    )  # fmt: skip
    search = Search(likelihood, first=("gravity_tilt", "lvdt_offset"))
    # 18 in twice the log-likelihood, less the price of a parameter, is below 10; the whole is worse by 7 only.
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}
    search = Search(likelihood | known(lvdt_offset__tacho_ripple=-4990.5), first=("gravity_tilt", "lvdt_offset"))
    assert selected(search)[0] == {"gravity_tilt": {"lvdt_offset"}, "tacho_ripple": set()}


def test_later_effects_keep_their_rivals():
    alike = known(
        gravity_tilt__cogging=-2001.0, lvdt_offset__cogging=-1991.0, force_offset__cogging=-1993.0,
    )  # fmt: skip
    search = Search(TILT | alike)
    seen = search.rejects

    def with_cogging(model):
        found = seen(model)
        if "tacho_ripple" in model.added or not model.added:
            return found
        return Findings((*found.scores, sized("cogging", 890.0, 1e-9)))

    search.rejects = with_cogging
    found, _ = selected(search)
    assert list(found) == ["lvdt_offset", "tacho_ripple"]
    assert found["tacho_ripple"] == {"cogging"}


@pytest.mark.parametrize(("least", "first"), [(0.0, "lvdt_offset"), (9950.0, "gravity_tilt")])
def test_what_takes_the_first_place_must_gain_what_the_look_asks(least, first):
    search = Search(TILT)
    scores = [sized(effect, 1000.0 - place, 1e-9) for place, effect in enumerate(FIRST)]
    look = _Look(scores, scores[1:], "filter", least)
    steps, _ = improvements(search, search.base, search.rejects(search.base), STANDARD, look)
    assert steps[0].id == first


@pytest.mark.parametrize(("single", "first"), [(False, "lvdt_offset"), (True, "gravity_tilt")])
def test_a_look_for_a_single_effect_judges_it_alone(single, first):
    search = Search(TILT)
    scores = [sized(effect, 1000.0 - place, 1e-9) for place, effect in enumerate(FIRST)]
    look = _Look(scores, scores[1:], "filter", single=single)
    steps, _ = improvements(search, search.base, search.rejects(search.base), STANDARD, look)
    assert steps[0].id == first


@pytest.mark.parametrize(
    "options", [{"loose": ["lvdt_offset"]}, {"held_out": {"lvdt_offset": -1.0}}], ids=["loose", "held out"]
)
def test_what_the_data_leave_free_or_other_experiments_refuse_takes_no_place(options):
    assert selected(Search(TILT, **options))[0] == {"force_offset": set(), "tacho_ripple": set()}


def test_a_rival_that_falls_behind_is_none_any_more():
    search = Search(TILT | known(lvdt_offset=-5002.0, force_offset=-9000.0, lvdt_offset__tacho_ripple=-2030.0))
    assert selected(search)[0] == {"gravity_tilt": set(), "tacho_ripple": set()}


@pytest.mark.parametrize(
    ("refits", "runners_up"), [(4, ("end_stop", "lvdt_offset", "force_offset")), (2, ("end_stop", "lvdt_offset"))]
)
def test_as_many_runners_up_are_asked_as_candidates_of_a_step_the_best_first(refits, runners_up):
    search = Search(TILT | known(end_stop=-5040.0, end_stop__tacho_ripple=-2500.0), first=(*FIRST, "end_stop"))
    policy = dataclasses.replace(STANDARD, refits=refits)
    improvements(search, search.base, search.rejects(search.base), policy)
    again = [effects for effects in search.asked if effects[-1] == "tacho_ripple" and len(effects) == 2]
    assert again == [(effect, "tacho_ripple") for effect in ("gravity_tilt", *runners_up)]


def test_what_a_later_effect_presupposes_stays():
    likelihood = known(
        base=-10_000.0,
        arm_coulomb=-5000.0,
        cogging=-5010.0,
        arm_coulomb__arm_stribeck=-2000.0,
        cogging__arm_stribeck=-1000.0,
    )
    search = Search(likelihood, first=("arm_coulomb", "cogging"), second="arm_stribeck")
    assert list(selected(search)[0]) == ["arm_coulomb", "arm_stribeck"]
    assert ("cogging", "arm_stribeck") not in search.asked


def test_a_single_effect_is_asked_once():
    search = Search(TILT)
    search.rejects = lambda model: Findings(() if model.added else tuple(sized(i, 1000.0, 1e-9) for i in FIRST))
    assert list(selected(search)[0]) == ["gravity_tilt"]
    assert all(len(effects) == 1 for effects in search.asked)


def test_a_law_and_what_it_presupposes_are_not_exchanged():
    likelihood = known(
        base=-10_000.0, arm_coulomb=-5000.0, arm_stribeck=-4990.0, arm_coulomb__tacho_ripple=-2000.0,
        arm_stribeck__tacho_ripple=-1900.0,
    )  # fmt: skip
    search = Search(likelihood, first=("arm_coulomb", "arm_stribeck"))
    assert list(selected(search)[0]) == ["arm_coulomb", "tacho_ripple"]
    assert ("arm_stribeck", "tacho_ripple") not in search.asked


LAGS = known(
    base=-10_000.0, encoder_lag=-9800.0, encoder_lag__arm_coulomb=-9400.0, encoder_lag__arm_coulomb__current_lag=-9100.0,
    arm_coulomb=-9900.0, current_lag=-9950.0, encoder_lag__current_lag=-9780.0,
)  # fmt: skip


class Lags(Known):
    """A laboratory in which a lag of the encoder shows first, then friction, then the lag of the current that it stood for."""

    def __init__(self, size, beside=-9101.0):
        self.size = size
        super().__init__(LAGS | known(arm_coulomb__current_lag=beside))
        order = ("encoder_lag", "arm_coulomb", "current_lag")

        def seen(model):
            left = [effect for effect in order if effect not in model.added and "current_lag" not in model.added]
            return Findings(tuple(sized(effect, 900.0 - 200.0 * n, 1e-9) for n, effect in enumerate(left)))

        self.rejects = seen

    def model(self, *effects):
        values = {"encoder_lag.size": (self.size if "current_lag" in effects else 1.0, 0.1)} if effects else {}
        return dataclasses.replace(super().model(*effects), values=values)


@pytest.mark.parametrize(
    ("size", "beside", "found"),
    [
        (0.19, -9101.0, ["arm_coulomb", "current_lag"]),
        (0.21, -9101.0, ["encoder_lag", "arm_coulomb", "current_lag"]),  # by more than two deviations
        (0.19, -9110.0, ["encoder_lag", "arm_coulomb", "current_lag"]),  # without it the data are less likely
    ],
)
def test_what_later_effects_leave_nothing_of_is_not_named(size, beside, found):
    search = Lags(size, beside)
    steps, _ = improvements(search, search.base, search.rejects(search.base), STANDARD)
    assert [step.id for step in steps] == found
    assert steps[-1].model.added == tuple(found)


def test_what_a_later_effect_presupposes_is_named_though_little_is_left_of_it():
    search = Lags(0.19)
    beside = EffectTraits(presupposes=("encoder_lag",))
    search.facts = dataclasses.replace(search.facts, effects={**search.facts.effects, "current_lag": beside})
    steps, _ = improvements(search, search.base, search.rejects(search.base), STANDARD)
    assert [step.id for step in steps] == ["encoder_lag", "arm_coulomb", "current_lag"]
