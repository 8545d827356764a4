"""A laboratory whose log-likelihoods are known beforehand, for tests of what is made of them."""

from collections.abc import Callable, Mapping, Sequence

from estimators.diagnosis.evidence import Facts, FittedModel, HeldOut, SimulationError
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.live_laboratory import traits
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.misspecification.findings import CriticalValues, Findings, Score, StaticForce
from rtac_jax.effects import CATALOGUE
from rtac_jax.effects.wrong_constant import WRONG_CONSTANTS

SIZES = {"arm_stribeck": 2, "arm_coulomb": 1, "lvdt_lag": 1, "cubic_spring": 1}
CRITICAL = STANDARD.critical
TRAITS = {i: traits(effect) for i, effect in (CATALOGUE | {c.id: c for c in WRONG_CONSTANTS.values()}).items()}


class Known:
    """A laboratory in which the log-likelihood with every set of effects is known beforehand."""

    def __init__(
        self,
        likelihood: dict[frozenset[str], float],
        loose: Sequence[str] = (),
        held_out: Mapping[str, float] | None = None,
    ) -> None:
        self.likelihood, self.runaways, self.gains = likelihood, loose, held_out or {}
        self.facts = Facts(10_000, 2, 2, rest=True, noise_known=False, samples_per_radian=20.0, effects=TRAITS)
        self.policy: DiagnosisPolicy = STANDARD
        self.values: dict[str, tuple[float, float]] = {}
        self.late: tuple[str, ...] = ()
        self.rejects: Callable[[FittedModel], Findings] = lambda model: Findings()
        self._models: list[FittedModel] = []
        self.base = self.model()

    def model(self, *effects: str) -> FittedModel:
        value = self.likelihood.get(frozenset(effects), 0.0)
        found = FittedModel(
            number=len(self._models),
            added=effects,
            parameters=sum(SIZES.get(e, 1) for e in effects),
            log_likelihood=value,
            by_stretch=(0.5 * value - 1.0, 0.5 * value + 1.0),
            looseness={e: 100.0 if e in self.runaways else 0.1 for e in effects},
            values=self.values,
        )
        self._models.append(found)
        return found

    def say(self, text: str) -> None:
        pass

    def first_refits(
        self, before: FittedModel, first: Score, near: Sequence[Score], way: Way
    ) -> dict[str, FittedModel]:
        return self.refits(before, [first, *near], way)

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        return {s.id: self.model(*before.added, s.id) for s in several}

    def unfitted(self, before: FittedModel) -> tuple[str, ...]:
        return self.late

    def findings(self, model: FittedModel) -> Findings | None:
        return self.rejects(model)

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        return ()

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        return ()

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        (effect,) = set(after.added) - set(before.added)
        gain = self.gains.get(effect, 1.0)
        return HeldOut((gain,), (0.0 if gain != gain else 1.0,))

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        return None

    def simulation(self, model: FittedModel) -> SimulationError | None:
        return None

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        return {}


def screened(effect: str) -> Score:
    return Score(effect, 0, ("size",), 100.0, 1e-9)


def sized(effect: str, statistic: float, p_value: float) -> Score:
    return Score(effect, 0, ("size",), statistic, p_value)


def force(excess: float) -> StaticForce:
    """A force that certainly explains so much."""
    return StaticForce("cart", "cart_position", 1e-9, excess)


def critical(**changed: float) -> CriticalValues:
    return CriticalValues(**({"alarm": CRITICAL.alarm, "chance": CRITICAL.chance, "level": CRITICAL.level} | changed))


def known(**likelihood: float) -> dict[frozenset[str], float]:
    """Log-likelihoods by effects, whose names are joined by `__`."""
    return {frozenset(names.split("__")) - {"base"}: value for names, value in likelihood.items()}
