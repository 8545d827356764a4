"""The rules for selection by simulation on made-up errors: when it is asked, when it goes on, and what it overrules."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from known_search import Known, force, known, sized
from made_up_results import candidate

from estimators.core.fisher_information import information_of
from estimators.core.fit import Fit
from estimators.core.results import RESULTS
from estimators.diagnosis import simulated_fits, simulation_selection
from estimators.diagnosis.evidence import FittedModel, SimulationError
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.selection import Selection, nameable
from estimators.diagnosis.simulation_remarks import found_by_simulation, untried
from estimators.diagnosis.verdict import decide
from estimators.misspecification.adequacy import AdequacyTest
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.findings import Findings, Score
from rtac_jax import RTAC
from rtac_jax.effects import GravityTilt

# Of a positioning axis whose encoder has next to no noise: errors of fitted simulations over it.
ERRORS = known(
    base=33_154.0, encoder_lag=33_154.0, arm_coulomb=8_374.0, arm_stribeck=8_007.0, current_offset=32_755.0,
    arm_coulomb__current_offset=65.0, arm_coulomb__encoder_lag=8_223.0, arm_coulomb__current_offset__encoder_lag=64.0,
)  # fmt: skip


class Axis(Known):
    """One whose predictions name `encoder_lag`, beside random torques of half the drive's, and whose simulation names friction."""

    asked: list[tuple[str, ...]]
    ways: list[Way]
    torque = 0.5
    named = 8_387.0  # error with what predictions name
    lag = 60.0  # what that explains of the residual without random forces

    def __init__(self, errors: Mapping[frozenset[str], float] = ERRORS) -> None:
        super().__init__(known(base=0.0, encoder_lag=5000.0, arm_coulomb=2000.0, arm_coulomb__current_offset=4000.0))
        self.errors, self.asked, self.ways = errors, [], []
        self.base = dataclasses.replace(self.base, random_torque=self.torque)

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        self.ways.append(way)
        found = super().refits(before, several, way)
        return {i: dataclasses.replace(model, random_torque=self.torque) for i, model in found.items()}

    def findings(self, model: FittedModel) -> Findings:
        scores = (sized("encoder_lag", 900.0, 1e-9), sized("arm_stribeck", 800.0, 1e-9))
        left = Findings() if "encoder_lag" in model.added else Findings(scores, curves=(force(2000.0),))
        return dataclasses.replace(left, scores=tuple(s for s in left.scores if s.id not in model.added))

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        scores = (
            sized("arm_coulomb", 400.0, 1e-9),
            sized("arm_stribeck", 340.0, 1e-9),
            sized("encoder_lag", self.lag, 1e-9),
        )
        return tuple(s for s in scores if s.id not in model.added)

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        scores = (sized("arm_coulomb", 450.0, 1e-9), sized("current_offset", 80.0, 1e-9), sized("dead_zone", 9.0, 0.1))
        return tuple(s for s in scores if s.id not in model.added)

    def simulation(self, model: FittedModel) -> SimulationError:
        error = {"arm_angle": self.named if model.added == ("encoder_lag",) else self.errors[frozenset(model.added)]}
        return SimulationError(error, {"arm_angle": 1.0}, {"arm_angle": 4e5}, (0.0, self.torque))

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        self.asked.append(tuple(s.id for s in several))
        found = {s.id: self.errors.get(frozenset({*before.added, s.id})) for s in several}
        return {i: {"arm_angle": error} for i, error in found.items() if error is not None}


def test_what_a_simulation_shows_overrules_what_predictions_name() -> None:
    laboratory = Axis()
    found = decide(laboratory, STANDARD, thorough=True)
    assert (found.verdict, found.effects) == ("missing", ("arm_coulomb", "current_offset"))
    assert found.removed == pytest.approx(1 - (65.0**2 - 1) / (33_154.0**2 - 1))
    # Stribeck friction leaves a little less at first, and presupposes dry friction.
    assert set(laboratory.asked[0]) == {"arm_coulomb", "current_offset", "encoder_lag", "arm_stribeck"}
    assert laboratory.ways.count("simulation") == 2  # enough is explained then


def test_it_is_said_why_simulations_select_and_how_far_the_error_falls() -> None:
    before = SimulationError({"arm_angle": 33_154.0}, {"arm_angle": 1.0}, {"arm_angle": 4e5}, (0.02, 0.5))
    after = dataclasses.replace(before, error={"arm_angle": 65.0})
    said = found_by_simulation(before, after, {})
    assert "This is what simulations select" in said
    assert "(2 % of the rms force and 50 % of the rms torque in one sample)" in said
    assert "falls from 3.32e+04 to 65 times the noise (arm_angle)" in said
    coloured = found_by_simulation(before, after, {"arm_angle": 2e-3})
    assert "to 65 times the coloured noise, of 0.002 rad rms (arm_angle)" in coloured


@pytest.mark.parametrize(
    ("excess", "refitted", "named"), [(50.0, False, True), (50.0, True, False), (-1.0, False, False)]
)
def test_what_was_as_large_as_an_alarm_and_not_tried_is_named(excess: float, refitted: bool, named: bool) -> None:
    backlash = candidate("backlash", 400.0, refitted=refitted)
    left = (AdequacyTest("static force", 0.0 if excess > 0 else 0.5, excess, 0.002, ""),)
    several = [candidate("lvdt_gain", 2.0), candidate("encoder_lag", 890.0), backlash]
    said = untried(several, {"encoder_lag"}, left, STANDARD)
    assert ("backlash (409, the alarm is at 20)" in said) == named
    assert "lvdt_gain" not in said
    assert "encoder_lag" not in said, "a simulation was fitted with it"
    assert bool(said) == named


@pytest.mark.parametrize("named", [100.0, 9.0])
def test_what_predictions_name_stands_where_the_simulation_follows_with_it_as_far(named: float) -> None:
    laboratory = Axis()
    laboratory.named = named
    assert decide(laboratory, STANDARD, thorough=True).effects == ("encoder_lag",)
    assert (laboratory.asked == []) == (named < 10)


def test_it_stands_where_the_base_model_is_near_the_data() -> None:
    laboratory = Axis({key: min(value, 9.0) for key, value in ERRORS.items()})
    assert decide(laboratory, STANDARD, thorough=True).effects == ("encoder_lag",)
    assert laboratory.asked == []


def test_it_stands_where_simulations_explain_a_part_only() -> None:
    laboratory = Axis(
        ERRORS | known(arm_coulomb__current_offset=3_000.0, arm_coulomb__current_offset__encoder_lag=2_900.0)
    )
    assert decide(laboratory, STANDARD, thorough=True).effects == ("encoder_lag",)


def test_it_ends_where_enough_is_explained() -> None:
    laboratory = Axis()
    laboratory.named = 33_154.0
    assert decide(laboratory, STANDARD, thorough=True).effects == ("arm_coulomb",)  # 6 % of the squared error is left
    assert len(laboratory.asked) == 1


@pytest.mark.parametrize(("left", "known", "asked"), [(0.15, True, False), (0.17, True, True), (0.15, False, True)])
def test_names_that_take_the_place_of_the_random_forces_are_not_doubted_where_the_noise_is_known(
    left: float, known: bool, asked: bool
) -> None:
    """Elsewhere what smooths takes their place as well, with whatever it leaves called noise."""

    class Replaced(Axis):
        def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
            found = super().refits(before, several, way)
            return {i: dataclasses.replace(model, random_torque=left) for i, model in found.items()}

    laboratory = Replaced()
    laboratory.facts = dataclasses.replace(laboratory.facts, noise_known=known)
    decide(laboratory, STANDARD, thorough=True)
    assert bool(laboratory.asked) == asked


@pytest.mark.parametrize(("lag", "asked"), [(199.0, True), (201.0, False)])
def test_a_name_that_explains_most_of_the_residual_without_random_forces_is_not_doubted(
    lag: float, asked: bool
) -> None:
    laboratory = Axis()
    laboratory.facts = dataclasses.replace(laboratory.facts, noise_known=True)
    laboratory.lag = lag
    decide(laboratory, STANDARD, thorough=True)
    assert bool(laboratory.asked) == asked


@pytest.mark.parametrize(("rejects", "size"), [(True, 0.1), (False, 0.5), (False, 0.1)])
def test_where_nothing_is_named_a_rejection_asks_or_random_forces_that_are_large(rejects: bool, size: float) -> None:
    class Unnamed(Axis):
        torque = size

        def findings(self, model: FittedModel) -> Findings:
            return Findings(curves=(force(2000.0),) if rejects else (), scores=())

    laboratory = Unnamed()
    found = decide(laboratory, STANDARD, thorough=False)
    asked = rejects or size > 0.3  # over the root of 20 samples in a radian
    assert bool(laboratory.asked) == asked
    assert found.effects == (("arm_coulomb",) if asked else ())


def test_what_works_by_contact_is_left_to_trials() -> None:
    class Loose(Axis):
        def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
            return (sized("backlash", 500.0, 1e-9), *super().equation_scores(model))

    laboratory = Loose()
    decide(laboratory, STANDARD, thorough=True)
    assert not any("backlash" in asked for asked in laboratory.asked)


def test_modest_random_forces_ask_for_no_simulation() -> None:
    class Calm(Axis):
        torque = 0.009

    laboratory = Calm()
    assert decide(laboratory, STANDARD, thorough=True).effects == ("encoder_lag",)
    assert laboratory.asked == []


def test_what_random_forces_hide_is_asked() -> None:
    laboratory = Axis()
    laboratory.facts = dataclasses.replace(laboratory.facts, untestable=("arm_coulomb",))
    assert decide(laboratory, STANDARD, thorough=True).effects == ("arm_coulomb", "current_offset")


def test_a_shaken_rig_keeps_its_name() -> None:
    """What random forces carry away no effect brings back."""
    laboratory = Axis(dict.fromkeys(ERRORS, 30.0) | known(base=60.0))
    laboratory.named = 30.0
    assert decide(laboratory, STANDARD, thorough=True).effects == ("encoder_lag",)
    assert laboratory.asked


def test_a_name_with_which_the_simulation_is_worse_is_overruled_too() -> None:
    laboratory = Axis(ERRORS | known(arm_coulomb=12_000.0))  # leaves 13 %
    laboratory.named = 60_000.0
    assert decide(laboratory, STANDARD, thorough=True).effects == ("arm_coulomb", "current_offset")


def test_where_the_best_has_no_predictor_the_next_is_taken() -> None:
    class Diverging(Axis):
        def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
            found = super().refits(before, several, way)
            return {i: model for i, model in found.items() if way != "simulation" or i != "arm_coulomb"}

    laboratory = Diverging(known(base=33_154.0, encoder_lag=33_154.0, arm_coulomb=80.0, arm_stribeck=81.0))
    laboratory.likelihood |= known(arm_stribeck=1900.0)
    assert decide(laboratory, STANDARD, thorough=True).effects == ("arm_stribeck",)


@pytest.mark.parametrize(
    ("cart", "effects"),
    [((1.2, 5.0), ("arm_coulomb",)), ((1.45, 5.0), ("arm_coulomb",)), ((1.2, 50.0), ("encoder_lag",))],
)
def test_no_channel_is_lost_for_another(cart: tuple[float, float], effects: tuple[str, ...]) -> None:
    class Both(Axis):
        def simulation(self, model: FittedModel) -> SimulationError:
            found = super().simulation(model)
            signal = {**found.signal, "cart_position": 100.0}
            return dataclasses.replace(found, error={**found.error, "cart_position": cart[0]}, signal=signal)

        def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
            found = super().simulation_errors(before, several)
            return {i: {**error, "cart_position": cart[1]} for i, error in found.items()}

    laboratory = Both(known(base=33_154.0, encoder_lag=33_154.0, arm_coulomb=5.0))
    laboratory.named = 33_154.0
    assert decide(laboratory, STANDARD, thorough=True).effects == effects


def test_a_channel_whose_noise_nobody_can_tell_from_none_decides_nothing() -> None:
    """One that reads the same throughout, which the model does not."""
    laboratory = Axis(known(base=1e290, encoder_lag=1e290, arm_coulomb=5.0))
    laboratory.named = 1e290
    laboratory.facts = dataclasses.replace(laboratory.facts, noise_known=False)
    found = simulation_selection.selected_by_simulation(
        laboratory, Selection(laboratory.base, laboratory.findings(laboratory.base), (), [], {}), STANDARD
    )
    assert found is None


def test_effects_that_leave_as_much_are_rivals() -> None:
    laboratory = Axis(known(base=33_154.0, encoder_lag=33_154.0, arm_coulomb=80.0, current_offset=81.0))
    found = decide(laboratory, STANDARD, thorough=True)
    assert (found.verdict, found.rivals) == ("ambiguous", {"arm_coulomb": ("current_offset",)})


@pytest.mark.parametrize(("across", "plausible"), [(3.8, True), (11.0, False)])
def test_a_simulation_may_end_at_a_gross_size_where_the_declaration_admits_it(across: float, plausible: bool) -> None:
    tilt = GravityTilt(0.01, 0.01)
    asked = Screened("gravity_tilt", tilt, ("along", "across"), np.zeros(2), 0.0, 1.0, np.ones(2), np.ones((3, 2)))
    known = information_of(np.eye(1), ("total_mass",), np.ones(1))
    fit = Fit(RTAC.paper() + GravityTilt(0.0, across), RESULTS.successful, known, {}, {}, {}, ("a",), {})
    assert simulated_fits._plausible(fit, asked, STANDARD) == plausible


@pytest.mark.parametrize(("dry", "also"), [(237.0, ["arm_coulomb"]), (230.0, [])])
def test_what_an_effect_contains_may_be_named_where_it_may_and_what_is_the_same_as_that(
    dry: float, also: list[str]
) -> None:
    """A cable of no stiffness was missing from an arm that coasts one way, as neither friction nor a torque was testable."""
    facts = dataclasses.replace(
        Known({}).facts, untestable=("arm_coulomb", "torque_offset", "current_lag", "arm_presliding")
    )
    several = [sized("cable_spring", 237.4, 1e-9), sized("torque_offset", 237.0, 1e-9), sized("arm_coulomb", dry, 1e-9)]
    found = nameable(facts, [*several, sized("current_lag", 90.0, 1e-9)])
    assert [s.id for s in found] == ["cable_spring", "torque_offset", *also]
    assert [s.id for s in nameable(facts, several[1:])] == []
