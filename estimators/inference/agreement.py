"""The agreement of estimates of the same physics: which differ, what that means, and what it does not confirm, in words."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.closed_form.table1 import CONSISTENT
from estimators.core.data import CHANNELS
from estimators.core.drawing import draw
from estimators.core.fit import FAR
from estimators.inference.assumptions import assumed
from estimators.inference.simulation_residual import SHAKEN, SimulationResidual

Vector = Float[np.ndarray, " quantity"]
_BROKEN_BY = 4  # effects that are named with an assumption, the likeliest ones
_DOUBTED = 0.05  # joint p-value, counted for all pairs, below which two estimates are not said to agree: the usual level of doubt
_HIDES = (
    " The random forces that the prediction error takes into account may stand for an effect that is missing; est.diagnose "
    "tells the two apart."
)


_ASK = " Add est.prediction_error_nonlinear's result, which estimates random forces, and ask est.diagnose."


@dataclasses.dataclass(frozen=True)
class Disagreement:
    """The difference between two estimators.

    Attributes:
        labels: of the two.
        difference: first less second, each after the step that the replicates take too, less what their own bias would make
            it were the model right; NaN for a quantity that one of them does not estimate.
        bias: that bias, taken off.
        std: of the difference, were the model right.
        p_values: per quantity.
        p_value: jointly.
    """

    labels: tuple[str, str]
    difference: Vector
    bias: Vector
    std: Vector
    p_values: Vector
    p_value: float


@dataclasses.dataclass(frozen=True)
class Agreement:
    """The result of `agreement`.

    Attributes:
        names: of the quantities that two estimators or more give: parameters, and natural frequency and damping ratio of
            the cart where a linear fit takes part.
        units: SI units.
        labels: of the estimators.
        asks: what the model must be right for so that this estimator is, in words.
        values: estimates [estimator quantity]; NaN where one does not give it.
        std: their standard deviations, were the model right [estimator quantity].
        pairs: every two estimators compared.
        level: at which a disagreement is called one.
        draws: replicates that the distribution of the differences was taken from.
        disturbed: whether the replicates hold random forces and torques.
        misfit: residual of each output error over the noise, of its worst channel, by label.
        simulation: what the residual of the first output error means where its noise is known; None without an output error.
        channels: that were recorded.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    asks: tuple[str, ...]
    values: Float[np.ndarray, "estimator quantity"]
    std: Float[np.ndarray, "estimator quantity"]
    pairs: tuple[Disagreement, ...]
    level: float
    draws: int
    disturbed: bool
    misfit: Mapping[str, float]
    simulation: SimulationResidual | None = None
    channels: tuple[str, ...] = CHANNELS

    @property
    def rejected(self) -> bool:
        """Return whether any two disagree by more than chance allows; the level is shared between the pairs."""
        return any(pair.p_value < self.level / len(self.pairs) for pair in self.pairs)

    @property
    def doubted(self) -> bool:
        """Return whether two differ by more than is usual, so that nothing is confirmed, be they rejected or not."""
        return self.worst.p_value * len(self.pairs) < max(_DOUBTED, self.level)

    @property
    def worst(self) -> Disagreement:
        """Return the two estimators that disagree most clearly."""
        return min(self.pairs, key=lambda pair: pair.p_value)

    @property
    def differing(self) -> tuple[str, ...]:
        """Quantities whose estimates differ, the clearest first; where they differ only jointly, the clearest one."""
        if not self.rejected:
            return ()
        smallest = np.min([np.nan_to_num(pair.p_values, nan=1.0) for pair in self.pairs], axis=0)
        order = np.argsort(smallest)
        bound = self.level / (len(self.names) * len(self.pairs))
        return tuple(self.names[i] for i in order if smallest[i] < bound) or (self.names[order[0]],)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Return the ids of effects that break the assumptions of these quantities, those of the clearest difference first.

        Where to look first, and no list to choose from: a fit of the whole motion hands an error on to other quantities too.
        """
        return tuple(dict.fromkeys(effect for _, effects in self._assumptions() for effect in effects))

    @property
    def _calm(self) -> bool:
        """Return whether random forces are next to nothing, or noise of a measured current, so that nothing hides behind them."""
        found = self.simulation
        return found is not None and (found.of_the_current or max(found.random_force, found.random_torque) < SHAKEN)

    @property
    def _unknown_noise(self) -> str:
        """Return what a simulation leaves where nobody knows the noise, if it is far beyond the fastest changes; else nothing."""
        found = self.simulation
        if found is None or found.cause != "noise" or found.noise_known or not found.ratio > FAR:
            return ""
        return (
            f"the simulation is left at {found.ratio:.3g} times the fastest changes of a channel, by noise that is slow or by what "
            "is missing, and a rest record would tell which."
        )

    @property
    def verdict(self) -> str:
        """Return the verdict in words: whether they agree, which assumption fails, and what to look at next."""
        smallest = self.worst.p_value
        if not self.rejected:
            chance = f"differences as large as these come about by chance (p = {smallest:.2g})."
            hides = _HIDES if "prediction error" in self.labels and not self._calm else ""
            words = self.simulation.words if self.simulation is not None else ""
            if self.simulation is not None and self.simulation.vetoes:
                return f"No two disagree: {chance} That confirms nothing. {words}{hides or _ASK}"
            if self._unknown_noise:
                return f"No two disagree: {chance} That confirms nothing: {self._unknown_noise}{hides or _ASK}"
            if self.doubted:
                return f"{self._nearly()}{' ' * bool(words)}{words}{self._untold()}{hides}"
            holds = words or "What the estimates rest on holds as far as these data can tell."
            # What random forces take up may be what is missing, and all estimates are off alike.
            agree = (
                "No two disagree"
                if self.simulation is not None and self.simulation.cause == "shaken" and hides
                else "They agree"
            )
            return f"{agree}: {chance} {holds}{self._untold()}{hides}"
        failing = [
            f"that {words} (broken by {', '.join(effects[:_BROKEN_BY])})" for words, effects in self._assumptions()
        ]
        fails = f" Doubt first {', then '.join(failing[:3])}." if failing else ""
        first, second = (self.asks[self.labels.index(label)] for label in self.worst.labels)
        both = f"both for {first} and for {second}." if first != second else f"for {first}."
        return (
            f"They disagree (p = {smallest:.2g}), most clearly in {', '.join(self.differing[:3])}: one model cannot be right "
            + both
            + fails
            + " Ask est.diagnose, which holds these and all others against the data; est.compare shows where the model fails."
            + self._but()
        )

    def _assumptions(self) -> list[tuple[str, tuple[str, ...]]]:
        """Return what the model assumes about the quantities that differ, each once, with the effects that break it."""
        known = [assumed(name, self.channels) for name in self.differing]
        return list(dict.fromkeys(assumption for assumption in known if assumption is not None))

    def _nearly(self) -> str:
        """Say what differs by more than is usual, though by less than the level of the test asks."""
        worst, several = self.worst, len(self.pairs)
        clearest = self.names[int(np.nanargmin(worst.p_values))]
        among = (
            f", and with {several} pairs one as large in {100 * worst.p_value * several:.2g} %" if several > 1 else ""
        )
        return (
            f"No two disagree at the level of {100 * self.level:.2g} %, but {worst.labels[0]} and {worst.labels[1]} differ, most "
            f"clearly in {clearest}, as they would by chance in {100 * worst.p_value:.2g} % of such recordings{among}: that "
            "confirms nothing, and a longer recording decides it."
        )

    def _untold(self) -> str:
        """Name the constants that every rig has and that the estimates are too unsure of to confirm each other."""
        sizes = np.nanmin(np.abs(self.values), axis=0)
        known = np.nanmin([np.where(np.isfinite(p.std), p.std, np.inf) for p in self.pairs], axis=0)
        untold = [
            name
            for name, size, std in zip(self.names, sizes, known, strict=True)
            if "." not in name and np.isfinite(std) and std > CONSISTENT * size
        ]
        if not untold:
            return ""
        least = f"{100 * CONSISTENT:.0f} %"
        return f" That tells nothing of {', '.join(untold)}: a difference would have to be larger than {least} to show."

    def _but(self) -> str:
        """Say what else than the model could be wrong with a disagreement."""
        if not self.disturbed:
            return (
                " A random force or torque on the rig makes them disagree too: add est.prediction_error_nonlinear's result, "
                "which counts it."
            )
        far = [label for label in self.worst.labels if self.misfit.get(label, 0.0) > FAR]
        if not far:
            return ""
        return (
            f" But the residual of {far[0]} is {self.misfit[far[0]]:.0f} times the noise, and how far a disturbance leads it "
            "is known to first order only: hold the others against each other without it."
        )

    def __str__(self) -> str:
        wide = max(15, *(len(label) for label in self.labels))
        lines = [f"{'quantity':26s}" + "".join(f" {label:>{wide}s} {'std':>9s}" for label in self.labels) + "  unit"]
        for i, name in enumerate(self.names):
            cells = "".join(
                f" {v[i]:{wide}.6g} {s[i]:9.2g}" if np.isfinite(v[i]) else " " * (wide + 11)
                for v, s in zip(self.values, self.std, strict=True)
            )
            lines.append(f"{name:26s}{cells}  {self.units[i]}")
        for pair in self.pairs:
            lines.append(f"\n{pair.labels[0]} less {pair.labels[1]}")
            lines.append(
                f"{'quantity':26s} {'difference':>12s} {'of it bias':>12s} {'std':>10s} {'sigmas':>8s} {'p':>9s}"
            )
            for i, name in enumerate(self.names):
                if not np.isfinite(pair.difference[i]):
                    continue
                lines.append(
                    f"{name:26s} {pair.difference[i] + pair.bias[i]:12.3g} {pair.bias[i]:12.2g} {pair.std[i]:10.2g} "
                    f"{pair.difference[i] / pair.std[i]:8.1f} {pair.p_values[i]:9.2g}"
                )
            lines.append(f"{'all together':26s} {'':12s} {'':12s} {'':10s} {'':8s} {pair.p_value:9.2g}")
        return "\n".join([*lines, "", self.verdict])

    def plot(self) -> Any:
        """Draw the differences in standard deviations, as a matplotlib figure."""
        return draw(self)
