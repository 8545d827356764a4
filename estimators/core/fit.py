"""The result of a fit of a physical model: estimates, their uncertainty, and the outcome."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.core.discounted import Discounted
from estimators.core.fisher_information import Information
from estimators.core.information_criteria import InformationCriteria
from estimators.core.parameter_correlation import ParameterCorrelations
from estimators.core.result_base import Result
from estimators.core.results import RESULTS, STOPPED
from estimators.core.undetermined import UNDETERMINED
from rtac_jax import RTAC
from rtac_jax.overview import Overview

HEADER = ("parameter", "value", "std", "unit")
FAR = 10.0
"""Times its noise, beyond which a channel's residual says that the model does not follow the rig."""

_MOVED = 4.0  # stated deviations of a constant, from which on chance has not moved it
# Gain in log-likelihood, half a squared deviation, from which on a fit that came to rest says that its slopes promise it. Sixty
# fits with dry friction and nothing missing ended at 0.05 at most, one at 20 beside a Stribeck friction that a kink kept off.
_KINK = 0.5
# Standard deviations: one that a fit holds there lies nearer, and one that happens to come so near seldom.
ON_BOUND = 0.02


# Constants of which effects show the product with their own, by the id of the effect.
_SHOWS = {"gravity_tilt": "eccentric_moment"}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """An estimate: value, standard deviation (zero where the parameter is fixed) and unit."""

    value: float
    std: float
    unit: str

    @property
    def is_fixed(self) -> bool:
        """Return whether it was not estimated."""
        return self.std == 0


class ModelFit(Result):
    """The estimates of a model's parameters, with the standard deviations that the data's information gives."""

    __slots__ = ()
    model: RTAC
    information: Information
    statistics: Mapping[str, Any]
    experiments: tuple[str, ...]
    each_std: Mapping[str, Float[np.ndarray, " experiment"]]

    @property
    def unexcited(self) -> frozenset[str]:
        """Return the names of the constants that nothing in the recording excites, as those of a cart that is always clamped."""
        shown = {_SHOWS[effect.id] for effect in self.model.effects if effect.id in _SHOWS}
        return frozenset(self.statistics.get("unexcited", ())) - shown - set(self.information.names)

    @property
    def held_deviations(self) -> Mapping[str, float]:
        """Return the standard deviations of parameters that are held at estimates of something else, by name."""
        return {}

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Return every shared parameter with its standard deviation."""
        estimated = np.sqrt(np.diagonal(self.information.covariance))
        deviations = {**self.held_deviations, **dict(zip(self.information.names, estimated, strict=True))}
        return {
            name: Parameter(float(np.asarray(self.model[name])), float(deviations.get(name, 0.0)), declared.unit)
            for name, declared in self.model.parameters.items()
            if name not in self.model.per_experiment
        }

    @property
    def each_parameters(self) -> dict[str, Parameter]:
        """Return what each experiment has for itself, as NAME[EXPERIMENT]; the deviation is NaN where it shows nothing of it."""
        found = {}
        for name in sorted(self.model.per_experiment):
            unit, shape = self.model.parameters[name].unit, (len(self.experiments),)
            values = np.broadcast_to(np.asarray(self.model[name]), shape)
            deviations = np.broadcast_to(self.each_std.get(name, np.nan), shape)
            for experiment, value, std in zip(self.experiments, values, deviations, strict=True):
                found[f"{name}[{experiment}]"] = Parameter(float(value), float(std), unit)
        return found

    def correlations(self) -> ParameterCorrelations:
        """Return the correlations of the free shared parameters, with the ellipses of any two."""
        found = self.parameters
        names = self.information.names
        return ParameterCorrelations(
            names,
            tuple(found[name].unit for name in names),
            np.array([found[name].value for name in names]),
            self.information.covariance,
        )

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Return every parameter that the recording excites as text: name, value, standard deviation and unit."""
        return [
            (name, f"{p.value:.6g}", "fixed" if p.is_fixed else "" if np.isnan(p.std) else f"{p.std:.2g}", p.unit)
            for name, p in (self.parameters | self.each_parameters).items()
            if name not in self.unexcited
        ]

    def on_bounds(self) -> dict[str, float]:
        """Return the bound on which an estimate ended, SI units, by the name of its parameter.

        Of effects that the data show: a mass is never nothing, and what is free is near every bound by its deviation.
        """
        reached = bounds_reached(self.model, self.information)
        return {name: bound for name, bound in reached.items() if self.information.looseness(name) < UNDETERMINED}

    @property
    def moved_constants(self) -> tuple[str, ...]:
        """Say of each constant that was measured by itself if the fit takes it far from that."""
        found = []
        for name in self.model.uncertain:
            prior, value = self.model.priors[name], float(np.asarray(self.model[name]))
            mean, std = float(np.asarray(prior.mean)), float(np.asarray(prior.std))
            if abs(value - mean) > _MOVED * std:
                found.append(
                    f"{name} ended at {value:.4g}, {abs(value - mean) / std:.2g} stated standard deviations from the {mean:.4g} +- "
                    f"{std:.2g} of the recording: that is wrong, or something that is missing takes it along."
                )
        return tuple(found)

    def lines(self) -> list[str]:
        """Return the same as lines of equal columns, below a head."""
        return [f"{name:30s} {value:>12s} {std:>10s}  {unit}" for name, value, std, unit in (HEADER, *self.rows())]


def bounds_reached(model: RTAC, information: Information) -> dict[str, float]:
    """Return the bound at which a free parameter of an effect lies, SI units, by its name."""
    deviations = np.sqrt(np.diagonal(information.covariance))
    return {
        name: bound
        for name, deviation in zip(information.names, deviations, strict=True)
        if "." in name
        for bound in model.parameters[name].bounds
        if abs(float(np.asarray(model[name])) - bound) < ON_BOUND * deviation
    }


def left_free(model: RTAC, information: Information) -> list[str]:
    """Describe what the data leave free where a fit ended; what an effect that ended on a bound has lost hangs on that bound."""
    return information.undetermined(beside={name.split(".")[0] for name in bounds_reached(model, information)})


@dataclasses.dataclass(frozen=True, repr=False)
class Fit(ModelFit):
    """The result of `output_error`.

    Attributes:
        model: with the estimated values; parameters of each experiment as arrays in the order of `experiments`.
        result: outcome of the optimisation.
        information: covariance and identifiability of the free parameters.
        noise: standard deviation of each channel's sensor noise.
        residual_std: rms of each channel's residual, which weighted the channels.
        start: states at the start of each experiment, SI units.
        experiments: names of the experiments.
        statistics: cost, or log_likelihood where predictions one sample ahead were fitted; pulled, the parameters that were left on
            a bound although the data pull them off it; promised, the gain in log-likelihood that the slopes promise at the end;
            steps, seconds, starts and how many agreed, substeps; samples of each channel, and the number of unknowns; whether long
            experiments were fitted in pieces.
        marks: of each experiment's measurements, which tell it from another of the same name.
        discounted: samples that hardly count, where the fit is robust.
        weights: of the squares in a robust fit, [sample output], by experiment; empty where all count alike.
        held: standard deviations of parameters that are fixed at estimates of something else, which those of the others count.
        each_std: standard deviations of the parameters of each experiment, the others integrated out.
    """

    model: RTAC
    result: RESULTS
    information: Information
    noise: Mapping[str, float]
    residual_std: Mapping[str, float]
    start: Mapping[str, Float[np.ndarray, " state"]]
    experiments: tuple[str, ...]
    statistics: Mapping[str, Any]
    marks: Mapping[str, str] = dataclasses.field(default_factory=dict)
    discounted: tuple[Discounted, ...] = ()
    weights: Mapping[str, Float[np.ndarray, "sample output"]] = dataclasses.field(default_factory=dict)
    held: Mapping[str, float] = dataclasses.field(default_factory=dict)
    each_std: Mapping[str, Float[np.ndarray, " experiment"]] = dataclasses.field(default_factory=dict)

    @property
    def held_deviations(self) -> Mapping[str, float]:
        """Return the standard deviations of parameters that are held at estimates of something else, by name."""
        return self.held

    def overview(self) -> Overview:
        """Return outcome, and parameters with standard deviations."""
        far = ", ".join(f"{c} {rms / self.noise[c]:.2f}" for c, rms in self.residual_std.items())
        title = f"{len(self.information.names)} parameters fitted to {len(self.experiments)} experiments"
        left = f"Residual over noise: {far}." if far else ""
        return Overview(title, HEADER, self.rows(), (RESULTS[self.result], left))

    @property
    def lost(self) -> bool:
        """Return whether it ended where the data leave parameters free, so that its values are no estimates."""
        return bool(self.result == RESULTS.undetermined)

    @property
    def residual_over_noise(self) -> dict[str, float]:
        """Return the rms of each channel's residual over the sensor's noise."""
        return {c: rms / self.noise[c] for c, rms in self.residual_std.items() if self.noise.get(c, 0.0) > 0}

    @property
    def farthest(self) -> float:
        """Return the largest residual over noise; zero where there is none."""
        return max(self.residual_over_noise.values(), default=0.0)

    @property
    def in_pieces(self) -> bool:
        """Return whether long experiments were fitted in pieces, each with a start of its own."""
        return bool(self.statistics.get("in_pieces", False))

    @property
    def outcome(self) -> str:
        """Return how the optimisation ended, and how far its starts can vouch for that, in a sentence or two."""
        said = f"{RESULTS[self.result]} {self.statistics['agreed']} of {self.statistics['starts']} starts agree."
        if self.result == RESULTS.pulled_off_bound and (pulled := self.statistics.get("pulled", ())):
            said += f" That is {', '.join(pulled)}."
        if self.lost:
            said += f" There {'; '.join(left_free(self.model, self.information))}: of these the fit says nothing."
        ratios = self.residual_over_noise
        said += "" if self.lost else "".join(f" {one}" for one in self.moved_constants)
        worst = max(ratios, key=lambda c: ratios[c], default="")
        far = bool(worst) and ratios[worst] > FAR
        no_such = (
            ", which tells nothing, as the model does not follow the rig"
            if far
            else ": the data ask for no such term in this model"
        )
        for name, bound in self.on_bounds().items():
            why = ", where these data hardly show it" if not far and self._hardly_shows(name) else no_such
            said += f" {name} ended on its bound, {bound:g}{why}."
        if (promised := self.statistics.get("promised", 0.0)) > _KINK:
            rest = self.result not in STOPPED
            said += (
                " It came to rest at a kink, as dry friction makes them, where the slopes" if rest else " The slopes"
            )
            said += f" still promise {promised:.2g} in log-likelihood: estimates may lie several of their deviations "
            said += "beside the best."
            said += " Begin elsewhere (starts), or hold it against est.prediction_error_nonlinear." if rest else ""
        elif self.result == RESULTS.steps_exhausted and promised > 0 and not far and not self.weights:
            apart = np.ceil(10 * np.sqrt(2 * promised)) / 10
            said += f" By their slopes the best is likelier by {promised:.2g} only, and lies within {apart:.1f} of the deviations."
        if far:
            anew = " in pieces of long experiments that begin anew, more in a whole one" if self.in_pieces else ""
            said += (
                f" The model does not follow the rig, {worst} being left at {ratios[worst]:,.0f} times its noise{anew}: there the "
                "sum of squares has many minima, and further starts may end in a lower one."
            )
        return said

    def _hardly_shows(self, name: str) -> bool:
        """Return whether a parameter is known to less than the size of another of its effect, as of the other direction."""
        mine = self.parameters[name]
        effect = name.rpartition(".")[0]
        like = [
            p
            for n, p in self.parameters.items()
            if n != name and n.rpartition(".")[0] == effect and p.unit == mine.unit
        ]
        return bool(effect and like) and mine.std > max(abs(p.value) for p in like)

    @property
    def criteria(self) -> InformationCriteria | None:
        """AIC, BIC and FPE; None for a model that is held at what a diagnosis estimated.

        The simulation's errors count as white, which they are where nothing is missing from the model.
        """
        if "samples" not in self.statistics:
            return None
        return InformationCriteria.of_rms(self.residual_std, self.statistics["samples"], self.statistics["unknowns"])

    def __str__(self) -> str:
        lines = self.lines()
        for channel, rms in self.residual_std.items():
            lines.append(f"residual of {channel}: {rms:.4g} rms, {rms / self.noise[channel]:.2f} times its noise")
        if self.weights:
            lines.extend(str(one) for one in self.discounted)
            if not self.discounted:
                lines.append("robust fit: no sample is discounted")
        if self.criteria is not None:
            lines.append(str(self.criteria))
        return "\n".join([*lines, self.outcome])
