"""A nominal model and an uncertainty weight that cover all operating conditions."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, cast, get_args

import control as ct
import numpy as np
import scipy.io
from jaxtyping import Bool, Complex128, Float64

from estimators.core.drawing import draw
from estimators.core.progress import Progress
from estimators.core.result_base import Result
from estimators.uncertainty.attribution import Attribution, attribute
from estimators.uncertainty.coverage import Coverage, held_out_coverage, scenario_coverage
from estimators.uncertainty.covering_weight import cover, needed
from estimators.uncertainty.nominal_model import NOMINAL_STEPS, log_measure, nominal_fit
from estimators.uncertainty.plant_set import PlantSet, Responses, evaluate, gather, require_stable
from estimators.uncertainty.uncertainty_structures import KINDS, Kind, corners, errors, packed
from estimators.uncertainty.weight import WEIGHT_STEPS, Minimise
from rtac_jax.measurement.atomic_write import replacing
from rtac_jax.overview import Overview
from rtac_jax.renamed import renamed

Curve = Float64[np.ndarray, " frequency"]

_DECIBEL = 20 / np.log(10)


@dataclass(frozen=True, eq=False, repr=False)
class Envelope(Result):
    """All plants that |Delta| <= 1 makes of a nominal model and a weight.

    Attributes:
        nominal: P_0, stable.
        weight: W, stable and minimum-phase.
        kind: of uncertainty, how Delta W enters; see `envelope`.
        names: of the conditions.
        frequency: [rad/s].
        plants: the responses covered, [condition, frequency].
        model_errors: model error of each about P_0, in the unit of W, [condition, frequency].
        profile: the largest model error at each frequency, over the conditions that were fitted and those held out.
        held_out: which conditions took no part in the fit.
        excess_db: distance of W above the profile, mean over log frequency [dB].
        largest_excess_db: the largest distance of W above the profile [dB].
        coverage: statement about a new condition.
        attribution: sources of the model errors.
        minimise: which distance of W from the profile was made least, "mean" or "largest".
    """

    nominal: ct.TransferFunction
    weight: ct.TransferFunction
    kind: Kind
    names: tuple[str, ...]
    frequency: Curve
    plants: Complex128[np.ndarray, "condition frequency"]
    model_errors: Float64[np.ndarray, "condition frequency"]
    profile: Curve
    held_out: Bool[np.ndarray, " condition"]
    excess_db: float
    largest_excess_db: float
    coverage: Coverage
    attribution: Attribution
    minimise: str = "mean"

    gaps = renamed("gaps", "model_errors")

    def nominal_response(self, omega: Curve | None = None) -> Complex128[np.ndarray, " frequency"]:
        """Return P_0(j omega); on the envelope's grid by default."""
        return evaluate([self.nominal], self.frequency if omega is None else omega)[0]

    def weight_magnitude(self, omega: Curve | None = None) -> Curve:
        """Return |W(j omega)|; on the envelope's grid by default."""
        return np.abs(evaluate([self.weight], self.frequency if omega is None else omega)[0])

    def distance(self, responses: Responses, omega: Curve | None = None) -> Float64[np.ndarray, " condition"]:
        """Return the largest |Delta| that each plant needs, over the band; at most 1 for those inside.

        Parametric systems are looked at between the frequencies of the grid, too.

        Raises:
            ValueError: as `envelope` does for its responses.
        """
        found = _representable(responses, self.frequency if omega is None else omega, self.kind)
        return needed(found, self.nominal, self.weight, self.kind)

    def covers(self, responses: Responses, omega: Curve | None = None) -> Bool[np.ndarray, " condition"]:
        """Return whether each plant lies inside at every frequency."""
        return self.distance(responses, omega) <= 1.0

    def save_mat(self, path: str | PathLike[str]) -> None:
        """Write a MAT file (version 5): P0 and W as num, den and as A, B, C, D; omega, plants, gaps (model errors) and profile."""
        contents: dict[str, Any] = {}
        for name, system in (("P0", self.nominal), ("W", self.weight)):
            state: Any = ct.tf2ss(system)
            contents[name] = {
                "num": np.asarray(system.num[0][0]), "den": np.asarray(system.den[0][0]),
                "A": state.A, "B": state.B, "C": state.C, "D": state.D,
            }  # fmt: skip
        contents |= {
            "kind": self.kind, "omega": self.frequency, "plants": self.plants, "gaps": self.model_errors, "profile": self.profile,
            "conditions": np.array(self.names, dtype=object), "held_out": self.held_out,
        }  # fmt: skip
        with replacing(path) as temporary:
            scipy.io.savemat(temporary, contents, appendmat=False)

    def overview(self) -> Overview:
        """Return orders, largest model error, where the weight is below one, and the coverage."""
        at = int(np.argmax(self.profile))
        magnitude = self.weight_magnitude()
        fraction = 100 * float(log_measure(self.frequency) @ (magnitude < 1))
        rows = [
            ("band [rad/s]", f"{self.frequency[0]:.3g} to {self.frequency[-1]:.3g}"),
            ("order of P0, of W", f"{len(self.nominal.poles())}, {len(self.weight.poles())}"),
            ("largest model error", f"{self.profile[at]:.3g} at {self.frequency[at]:.3g} rad/s"),
            ("|W| < 1 on [% of the band]", f"{fraction:.0f}"),
            ("W above the profile [dB]", f"{self.excess_db:.1f} on the mean, {self.largest_excess_db:.1f} at most"),
        ]
        title = f"{self.kind} envelope of {len(self.plants)} conditions"
        return Overview(title, ("", "value"), rows, (f"Coverage: {self.coverage}.",))

    def __str__(self) -> str:
        def roots(values: np.ndarray) -> str:
            shown = [v for v in np.sort_complex(values) if v.imag >= 0]
            return ", ".join(f"{v.real:.4g}" + (f" ± j{v.imag:.4g}" if v.imag > 0 else "") for v in shown) or "none"

        at = int(np.argmax(self.profile))
        magnitude = self.weight_magnitude()
        below = self.frequency[magnitude < 1]
        useful = (
            f"|W| < 1 on {100 * float(log_measure(self.frequency) @ (magnitude < 1)):.0f} % of the band (log scale)"
        )
        useful += f", from {below[0]:.3g} to {below[-1]:.3g} rad/s" if len(below) else ""
        lines = [
            f"{self.kind} envelope of {len(self.plants)} conditions, {self.frequency[0]:.3g} to {self.frequency[-1]:.3g} rad/s",
            f"P0 poles: {roots(self.nominal.poles())}",
            f"P0 zeros: {roots(self.nominal.zeros())}",
            f"W poles:  {roots(self.weight.poles())}",
            f"W zeros:  {roots(self.weight.zeros())}",
            f"largest model error {self.profile[at]:.3g} at {self.frequency[at]:.3g} rad/s",
            f"W lies {self.excess_db:.1f} dB above the profile on average, {self.largest_excess_db:.1f} dB at most",
            useful if self.kind != "additive" else "",
            "|W| >= 1 everywhere: no controller can hold all of these; their phases or signs differ, or P0 needs a higher order"
            if self.kind != "additive" and not len(below)
            else "",
            f"coverage: {self.coverage}",
        ]
        return "\n".join(line for line in lines if line)

    def plot(self) -> Any:
        """Draw Fig. 6 of the paper: responses and nominal model, profile and weight, and the sources of the model errors."""
        return draw(self)


def envelope(
    responses: Responses,
    *,
    omega: Float64[np.ndarray, " grid"] | None = None,
    kind: str = "multiplicative_output",
    order_nominal: int = 4,
    zeros: int | None = None,
    order_weight: int = 2,
    minimise: str = "mean",
    nominal: ct.TransferFunction | ct.StateSpace | None = None,
    held_out: Sequence[int | str] = (),
    importance: Float64[np.ndarray, " factor"] | None = None,
    std: Float64[np.ndarray, "condition frequency"] | None = None,
    amplitude: Float64[np.ndarray, " condition"] | None = None,
    within_db: float = 12.0,
    confidence: float = 0.95,
    progress: bool = True,
) -> Envelope:
    """Fit the stable nominal model that is least far from all plants, and a weight above all model errors (equation (7)).

    A scalar plant P is written with |Delta| <= 1 as (1 + Delta W) P_0, "multiplicative_output" or, the same for a
    scalar plant, "multiplicative_input", as P_0 + Delta W, "additive", or as P_0 / (1 + Delta W),
    "inverse_multiplicative".

    P_0 makes the largest model error over conditions and frequencies as small as possible; its zeros may lie in the
    right half plane. W lies above the largest model error at every frequency, also between the points of the grid,
    where parametric plants are evaluated and others interpolated on logarithmic scales; its distance above, in decibels
    over log frequency, is as small as possible, on the mean or at most. Both searches are local, from several starts.

    Args:
        responses: frequency responses of the conditions, python-control systems, or numbers [condition, frequency]; of
            stable plants unless the kind is inverse, which is checked where systems are given.
        omega: [rad/s], for numbers and for parametric systems.
        kind: of uncertainty, one of the four names above.
        order_nominal: poles of P_0.
        zeros: of P_0; by default as many as poles.
        order_weight: poles and zeros of W.
        minimise: the "mean" distance of W above the profile, which gives a controller most room, or the "largest", so that no
            frequency is treated worse than it must be.
        nominal: given instead of fitted.
        held_out: numbers or names of conditions that take no part in the fit. W is raised where they ask for it, and the statement
            of coverage rests on them alone; without any it rests on the fitted ones, which says little for few.
        importance: factor on the model error at each frequency that P_0 minimises, for instance below 1 where control does
            nothing.
        std: of the responses; by default theirs.
        amplitude: of each condition's input; by default theirs.
        within_db: largest mean excess of W over the profile that is still called covering.
        confidence: of the statement of coverage [1].
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        ValueError: fewer than two conditions to fit, an unstable nominal or plant, a plant or nominal that is zero where the
            kind divides by it, orders out of range, or a weight that covers only far above the profile.
    """
    chosen, free = _checked(kind, order_nominal, order_weight, zeros, minimise, confidence)
    found = _representable(responses, omega, chosen)
    held = _held(found.names, held_out)
    if kind != "additive" and np.any(found.plants == 0):
        raise ValueError(
            f"responses: a plant is zero at a frequency, where a {kind} model error has no size; use kind='additive'."
        )
    if std is not None and std.shape != found.plants.shape:
        raise ValueError(f"std: has shape {std.shape}; give one for each response, {found.plants.shape}.")
    weightings = np.ones(len(found.omega)) if importance is None else importance
    if weightings.shape != found.omega.shape or not np.all(weightings > 0):
        raise ValueError(f"importance: give {len(found.omega)} positive factors, one for each frequency.")

    fitted = found.plants[~held]
    kept = corners(fitted, chosen)
    with Progress("envelope", show=progress, total=NOMINAL_STEPS + WEIGHT_STEPS) as shown:
        if nominal is None:
            fit = nominal_fit(
                found.omega, packed(fitted, kept), chosen, order=order_nominal, zeros=free, importance=weightings,
                done=shown.count,
            )  # fmt: skip
            model = _named(ct.tf(*fit.coefficients()), "P0")
        else:
            model = _given(nominal)
            shown.count(NOMINAL_STEPS)
        shape, raised, profile = cover(found, held, model, chosen, order_weight, cast(Minimise, minimise), shown.count)
    measure = log_measure(found.omega)
    above = _DECIBEL * (shape.log_magnitude(found.omega) - np.log(profile))
    excess = float(measure @ above)
    lifted = _DECIBEL * float(np.log(raised))
    if held.any() and excess > within_db >= excess - lifted:
        worst = found.names[
            int(np.argmax(np.where(held, needed(found, model, ct.tf(*shape.coefficients()), chosen), 0.0)))
        ]
        raise ValueError(
            f"held_out: {worst} lies {raised:.2g} times outside the weight of those that were fitted, which lifts it by "
            f"{lifted:.1f} dB at all frequencies, to {excess:.1f} dB above the profile where within_db = {within_db:g}; fit it "
            "too, leave it out, or raise within_db."
        )
    if excess > within_db:
        raise ValueError(
            f"order_weight: a weight of order {order_weight} covers the profile only {excess:.1f} dB above it on average, more "
            f"than within_db = {within_db:g}; raise order_weight or order_nominal, or within_db."
        )
    response = evaluate([model], found.omega)[0]
    model_errors = np.abs(errors(found.plants, response, chosen))
    coverage = (
        held_out_coverage(int(held.sum()), confidence=confidence, raised=raised)
        if held.any()
        else scenario_coverage(len(found.plants), int(kept.any(axis=1).sum()), confidence=confidence)
    )
    return Envelope(
        nominal=model,
        weight=_named(ct.tf(*shape.coefficients()), "W"),
        kind=chosen,
        names=found.names,
        frequency=found.omega,
        plants=found.plants,
        model_errors=model_errors,
        profile=model_errors.max(axis=0),
        held_out=held,
        excess_db=excess,
        largest_excess_db=float(np.max(above)),
        coverage=coverage,
        attribution=attribute(
            found.plants, response, chosen, std=found.std if std is None else std,
            amplitude=found.amplitude if amplitude is None else amplitude,
        ),
        minimise=minimise,
    )  # fmt: skip


def _checked(
    kind: str, order_nominal: int, order_weight: int, zeros: int | None, minimise: str, confidence: float
) -> tuple[Kind, int]:
    """Return the kind of uncertainty and the number of the nominal model's zeros, after checking what was asked.

    Raises:
        ValueError: as `envelope`.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: is {kind!r}; use one of {', '.join(KINDS)}.")
    chosen = cast(Kind, kind)
    if order_nominal < 1 or order_weight < 0:
        raise ValueError(f"order_nominal, order_weight: are {order_nominal} and {order_weight}; give at least 1 and 0.")
    free = order_nominal if zeros is None else zeros
    if not 0 <= free <= order_nominal:
        raise ValueError(f"zeros: is {zeros}; a proper model of order {order_nominal} has from 0 to {order_nominal}.")
    if minimise not in get_args(Minimise):
        raise ValueError(f"minimise: is {minimise!r}; use 'mean' or 'largest'.")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: is {confidence}; give a probability between 0 and 1.")
    return chosen, free


def _held(names: Sequence[str], held_out: Sequence[int | str]) -> Bool[np.ndarray, " condition"]:
    """Return which conditions are held out.

    Raises:
        ValueError: there is no such condition, or fewer than two are left.
    """
    count = len(names)
    held = np.zeros(count, dtype=bool)
    for one in held_out:
        number = names.index(one) if isinstance(one, str) and one in names else one
        if isinstance(number, str) or not -count <= number < count:
            raise ValueError(f"held_out: there is no condition {one!r}; there are {count}: {', '.join(names)}.")
        held[number] = True
    if np.sum(~held) < 2:
        raise ValueError(
            f"responses: {int(np.sum(~held))} condition is left to fit, which has no scatter to cover; give at least two, or "
            "plants drawn from a parameter covariance."
        )
    return held


def _representable(responses: Responses, omega: Float64[np.ndarray, " grid"] | None, kind: Kind) -> PlantSet:
    """Gather the responses on one grid, and check that this kind of uncertainty can represent them.

    Raises:
        ValueError: as `gather`, or a plant is not stable although the kind is not inverse.
    """
    found = gather(responses, omega)
    if kind != "inverse_multiplicative":  # 1 / (1 + Delta W) may be unstable
        require_stable(found)
    return found


def _given(nominal: ct.TransferFunction | ct.StateSpace) -> ct.TransferFunction:
    if not isinstance(nominal, ct.TransferFunction | ct.StateSpace):
        raise ValueError(
            f"nominal: is a {type(nominal).__name__}; give a transfer function or a state-space system of control."
        )
    if nominal.dt:
        raise ValueError("nominal: is a discrete-time system; give its continuous-time equivalent.")
    poles: Any = np.asarray(nominal.poles())
    unstable = poles[poles.real >= 0]
    if len(unstable):
        raise ValueError(
            f"nominal: has a pole at {unstable[0]:.4g}, and an unstable model cannot be nominal; fit one that is stable, or leave "
            "it out."
        )
    return _named(ct.tf(nominal), "P0")


def _named(system: ct.TransferFunction, name: str) -> ct.TransferFunction:
    system.name = name
    return system
