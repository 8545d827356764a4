"""The rules for gross effects on made-up likelihoods: when the equations of motion are asked, and what is named after them."""

import dataclasses
from collections.abc import Sequence

import pytest
from known_search import Known, force, known, sized

from estimators.diagnosis.evidence import FittedModel, SimulationError
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.verdict import decide
from estimators.misspecification.findings import Findings, Score

LIKELIHOOD = known(base=0.0, cubic_spring=5000.0, lvdt_lag=4600.0)


class Gross(Known):
    """One whose base model follows nothing: innovations speak for `lvdt_lag`, the equations for `cubic_spring`."""

    ways: list[Way]
    begun: list[FittedModel]  # the models that were extended, one for each of these
    left_over = 1e-5  # random torque with an effect in the model
    error = 50.0  # of a simulation, over the noise

    def __init__(self, *, unfollowed: float = 0.8, torque: float = 0.6) -> None:
        super().__init__(LIKELIHOOD)
        self.ways, self.begun = [], []
        self.facts = dataclasses.replace(self.facts, unfollowed=unfollowed, noise_known=True)
        self.base = dataclasses.replace(self.base, random_torque=torque)

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        self.ways.append(way)
        self.begun.append(before)
        found = super().refits(before, several, way)
        return {i: dataclasses.replace(model, random_torque=self.left_over) for i, model in found.items()}

    def findings(self, model: FittedModel) -> Findings:
        return Findings() if model.added else Findings((sized("lvdt_lag", 900.0, 1e-9),), curves=(force(2000.0),))

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        return (sized("cubic_spring", 700.0, 1e-9), sized("arm_coulomb", 3.0, 0.1))

    def simulation(self, model: FittedModel) -> SimulationError:
        return SimulationError(
            {"arm_velocity": self.error}, {"arm_velocity": 1.0}, {"arm_velocity": 60.0}, (0.0, self.left_over)
        )


def test_the_equations_are_asked_and_a_step_begins_there() -> None:
    laboratory = Gross()
    found = decide(laboratory, STANDARD, thorough=True)
    assert found.verdict == "missing"
    assert found.effects == ("cubic_spring",)
    assert set(laboratory.ways) == {"equations"}
    assert "arm_coulomb" not in found.selection.tried  # what gains nothing there is not refitted


def test_what_only_a_sensor_shows_stands_beside_what_the_equations_name() -> None:
    """A constant force and the sensor's zero are one on a linear spring; only the force has a part in the equations."""

    class Offset(Gross):
        def findings(self, model: FittedModel) -> Findings:
            scores = (sized("force_offset", 800.0, 1e-9), sized("lvdt_offset", 799.0, 1e-9))
            return Findings() if model.added else Findings(scores, curves=(force(2000.0),))

        def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
            return (sized("force_offset", 700.0, 1e-9),)

    laboratory = Offset()
    laboratory.likelihood = known(base=0.0, force_offset=5000.0, lvdt_offset=4999.5)
    found = decide(laboratory, STANDARD, thorough=True)
    assert found.verdict == "ambiguous"
    assert found.rivals == {"force_offset": ("lvdt_offset",)}
    laboratory.likelihood = known(
        base=0.0, force_offset=5000.0, lvdt_offset=4000.0
    )  # as on a spring that is not linear
    assert decide(laboratory, STANDARD, thorough=True).verdict == "missing"


@pytest.mark.parametrize(("unfollowed", "torque"), [(0.2, 0.6), (0.8, 0.01)])
def test_a_fit_that_follows_or_is_hardly_shaken_goes_the_ordinary_way(unfollowed: float, torque: float) -> None:
    laboratory = Gross(unfollowed=unfollowed, torque=torque)
    assert decide(laboratory, STANDARD, thorough=True).effects == ("lvdt_lag",)
    assert set(laboratory.ways) == {"filter"}


def test_where_the_equations_name_nothing_the_ordinary_way_follows() -> None:
    class Silent(Gross):
        def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
            return ()

    laboratory = Silent()
    assert decide(laboratory, STANDARD, thorough=True).effects == ("lvdt_lag",)
    assert set(laboratory.ways) == {"filter"}


@pytest.mark.parametrize(("shown", "effect"), [(9_999.0, "cubic_spring"), (10_001.0, "lvdt_lag")])
def test_what_the_innovations_show_more_of_than_the_equations_explain_comes_first(shown: float, effect: str) -> None:
    """As of a measured circuit whose input was declared wrongly: 8,866 of it beside 203 for the cubic spring."""

    class Louder(Gross):
        def findings(self, model: FittedModel) -> Findings:
            return Findings() if model.added else Findings((sized("lvdt_lag", shown, 1e-9),), curves=(force(2000.0),))

    assert decide(Louder(), STANDARD, thorough=True).effects == (effect,)


def test_no_second_step_from_the_equations_is_asked_where_the_first_explains_less() -> None:
    class Leaving(Gross):
        def findings(self, model: FittedModel) -> Findings:
            left = (sized("lvdt_lag", 10_001.0, 1e-9), sized("cubic_spring", 900.0, 1e-9))
            return Findings(tuple(s for s in left if s.id not in model.added), curves=(force(2000.0),))

    laboratory = Leaving()
    decide(laboratory, STANDARD, thorough=False)
    last = len(laboratory.ways) - laboratory.ways[::-1].index("equations")
    assert not laboratory.begun[last].added  # the ordinary way begins anew at once


@pytest.mark.parametrize(("left_over", "error", "verdict"), [(0.1, 50.0, "unknown"), (0.1, 1.0, "missing")])
def test_what_needs_random_forces_must_be_followed_by_a_simulation(
    left_over: float, error: float, verdict: str
) -> None:
    laboratory = Gross()
    laboratory.left_over, laboratory.error = left_over, error
    found = decide(laboratory, STANDARD, thorough=True)
    assert found.verdict == verdict
    assert (found.simulation is None) == (verdict == "missing")
    assert [step.id for step in found.steps or found.further] == ["cubic_spring"]


def test_ordinary_diagnoses_are_not_asked_for_a_simulation_of_what_they_name() -> None:
    laboratory = Gross(unfollowed=0.2)
    laboratory.left_over = 0.1
    assert decide(laboratory, STANDARD, thorough=True).verdict == "missing"


@pytest.mark.parametrize(("shaken", "verdict"), [(600.0, "missing"), (20.0, "unknown")])
def test_what_random_forces_stand_for_beside_what_is_named_is_for_the_next_diagnosis(
    shaken: float, verdict: str
) -> None:
    """Of a pendulum gravity was named while friction was missing; forces that explain too little refuse a name."""

    class Beside(Gross):
        left_over = 0.1

        def simulation(self, model: FittedModel) -> SimulationError:
            return SimulationError(
                {"arm_velocity": 50.0}, {"arm_velocity": shaken}, {"arm_velocity": 2000.0}, (0.0, self.left_over)
            )

    assert decide(Beside(), STANDARD, thorough=True).verdict == verdict


@pytest.mark.parametrize(
    ("shaken", "motion", "verdict"),
    [(400.0, 1000.0, "unknown"), (40.0, 1000.0, "adequate"), (400.0, 3000.0, "adequate")],
)
def test_random_forces_that_cannot_act_leave_nothing_adequate_though_nobody_knows_the_noise(
    shaken: float, motion: float, verdict: str
) -> None:
    class Shaken(Known):
        def simulation(self, model: FittedModel) -> SimulationError:
            return SimulationError({"arm_angle": 20.0}, {"arm_angle": shaken}, {"arm_angle": motion}, (0.0, 0.2))

    laboratory = Shaken(LIKELIHOOD)
    assert not laboratory.facts.noise_known
    found = decide(laboratory, STANDARD, thorough=False)
    assert found.verdict == verdict
    assert (found.simulation is not None and found.simulation.overstated) == (verdict == "unknown")
