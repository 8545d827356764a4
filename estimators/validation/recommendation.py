"""One estimate and one standard deviation of each parameter, where several are at hand, by a stated rule."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.core.correlation import LEVEL
from estimators.core.fit import FAR, HEADER, Fit, Parameter
from estimators.core.result_base import Result
from estimators.core.results import STOPPED
from estimators.inference.robust_covariance import Covariances
from estimators.prediction_error.fit import PredictorFit
from estimators.validation.simulation_error import Compared
from rtac_jax.arguments import checked_arguments
from rtac_jax.overview import Overview, aligned

RULE = (
    "The rule: output error with its plain standard deviation where its residuals are white and their colour would not double it; "
    "else prediction error, where its innovations are white, of more than half of the samples, or where output error did not "
    "converge or ended where the data leave parameters free; else the larger of the deviations for a coloured residual and for "
    "independent experiments, with output error, or, where that does not follow the rig, with prediction error."
)
_MOST = 0.5  # of the measured samples, that white innovations have to be of
_WIDER = (
    2.0  # times a plain deviation, from which on a residual's colour counts though too few samples show it to a test
)


@dataclasses.dataclass(frozen=True, repr=False)
class Recommendation(Result):
    """The estimates to use, and why.

    Attributes:
        parameters: value, standard deviation and unit; the deviation of a fixed parameter is zero.
        estimator: "output error" or "prediction error".
        deviation: what the standard deviations take for granted, in words.
        sound: whether the model passes the test of its own residuals; otherwise no standard deviation holds what the model lacks.
        adequate: whether a diagnosis found nothing missing, and the simulation is at the noise.
        diagnosed: whether a diagnosis was made of the model, whatever it found.
        left: residual of output error over the noise, of its worst channel; zero where that is white.
        unexcited: names of constants that nothing in the recording excites, which no table shows.
        moved: of prediction error what constants that were measured by themselves it takes far from that, in words.
    """

    parameters: Mapping[str, Parameter]
    estimator: str
    deviation: str
    sound: bool
    adequate: bool = False
    diagnosed: bool = False
    left: float = 0.0
    moved: tuple[str, ...] = ()
    unexcited: frozenset[str] = frozenset()

    @property
    def sentence(self) -> str:
        """Return which estimator is recommended, with which standard deviation, and what that leaves out."""
        said = f"Recommended: {self.estimator}, with the standard deviation for {self.deviation}."
        if self.left > FAR and self.estimator == "prediction error" and not self.adequate:
            said += (
                f" But no simulation follows the rig: output error is left at {self.left:,.0f} times the noise. Where random forces"
                " shake the rig these are right all the same; where they"
                if self.sound
                else " Where random forces"
            )
            said += " stand for what the model lacks no estimate is right, whatever its deviation"
            said += "." if self.diagnosed else ", and est.diagnose looks for that."
        elif self.left > FAR and self.estimator == "output error":
            said += (
                f" But output error does not follow the rig, being left at {self.left:,.0f} times the noise: where the model lacks"
                " something no estimate is right, whatever its deviation, so take these for no more than where to begin."
            )
        if not self.sound and self.adequate:
            said += (
                " A residual is coloured though nothing is found missing: by noise that a sensor has itself, by how it is rounded,"
                " or by what is too small to be named, which no deviation counts."
            )
        elif not self.sound and self.diagnosed:
            said += (
                " A residual is coloured: by noise that a sensor has itself, or by what no deviation counts, as what the diagnosis"
                " names and a fit does not follow, what it does not name, or random forces."
            )
        elif not self.sound:
            said += (
                " A residual is coloured: by noise that a sensor has itself, or as something is missing, which no deviation counts;"
                " est.diagnose tells whether it can be named."
            )
        return " ".join([said, *self.moved])

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Return every parameter as text: name, value, standard deviation and unit."""
        return [
            (name, f"{p.value:.6g}", f"{p.std:.2g}" if p.std else "fixed", p.unit)
            for name, p in self.parameters.items()
            if name not in self.unexcited
        ]

    def overview(self) -> Overview:
        """Return the estimates to use, and which they are."""
        return Overview(f"{len(self.rows())} parameters by {self.estimator}", HEADER, self.rows(), (self.sentence,))

    def __str__(self) -> str:
        return "\n".join([*aligned([HEADER, *self.rows()], right=(1, 2)), self.sentence])


@checked_arguments
def recommended(
    fit: Fit, fitted: Compared, *, predicted: PredictorFit | None = None, spread: Covariances | None = None
) -> Recommendation:
    """Return one estimate and one standard deviation of each parameter.

    Output error is the maximum of the likelihood where its residual is white, and nothing does better; prediction error is it
    where random forces act and its innovations are white. Where neither holds, the deviations of output error that assume
    least are the ones to give.

    Args:
        fit: of output error.
        fitted: the same model compared with the recording that was fitted.
        predicted: prediction error of the same model on the same recording.
        spread: covariances of the fit.

    Source: Ljung, System Identification (1999), sections 7.4 and 9.3; White, Econometrica 50 (1982).
    """
    advice = _recommended(fit, fitted, predicted, spread)
    return dataclasses.replace(advice, unexcited=fit.unexcited)


def _recommended(
    fit: Fit, fitted: Compared, predicted: PredictorFit | None, spread: Covariances | None
) -> Recommendation:
    refused = _refused(fit)
    if not refused and _white([trace.whiteness_p for trace in fitted.traces]) and not _wider(fit, spread):
        return Recommendation(fit.parameters, "output error", "a white residual, which it has", True)
    kinds = {}
    if spread is not None:
        kinds = {"a coloured residual": spread.std("sandwich"), "independent experiments": spread.std("clustered")}
    if predicted is not None:
        # Of a rig that all but rests most samples are left out, and innovations of the others say little.
        most = predicted.statistics.get("counted", 1.0) > _MOST
        white = most and _white([w.p_value for w in predicted.whiteness])
        if white or refused:
            has = " not" if most else " of fewer than half of the samples"
            deviation = f"white innovations, which it has{'' if white else f'{has}; output error {refused}'}"
            return Recommendation(
                predicted.parameters,
                "prediction error",
                deviation,
                white,
                left=0.0 if refused else fit.farthest,
                moved=predicted.moved_constants,
            )
        if fit.farthest > FAR:
            # Its values are nearer then, and its deviations too small for what the model lacks.
            own = {name: p.std for name, p in predicted.parameters.items()}
            found = _with_largest(predicted.parameters, [own, *kinds.values()])
            astray = f"output error does not follow the rig, being left at {fit.farthest:,.0f} times the noise"
            words = " or ".join([*kinds, "white innovations"])
            deviation = f"{words}, the largest; {astray}"
            return Recommendation(
                found, "prediction error", deviation, False, left=fit.farthest, moved=predicted.moved_constants
            )
    if not kinds:
        return Recommendation(
            fit.parameters, "output error", "a white residual, which it has not", False, left=fit.farthest
        )
    found = _with_largest(fit.parameters, list(kinds.values()))
    return Recommendation(found, "output error", f"{' or '.join(kinds)}, the larger of both", False, left=fit.farthest)


def _with_largest(
    parameters: Mapping[str, Parameter], deviations: Sequence[Mapping[str, float]]
) -> dict[str, Parameter]:
    """Return the parameters with the largest of these standard deviations that are known, each by name."""

    def largest(name: str, plain: float) -> float:
        return max([s[name] for s in deviations if np.isfinite(s.get(name, np.nan))], default=plain)

    return {name: dataclasses.replace(p, std=largest(name, p.std)) for name, p in parameters.items()}


def _wider(fit: Fit, spread: Covariances | None) -> bool:
    """Return whether a coloured residual makes a known parameter far less sure: few samples may hide its colour from a test."""
    if spread is None:
        return False
    coloured = spread.std("sandwich")
    known = {name: p for name, p in fit.parameters.items() if 0 < p.std < abs(p.value)}
    return any(coloured.get(name, 0.0) > _WIDER * p.std for name, p in known.items())


def _refused(fit: Fit) -> str:
    """Return why output error is no estimate; empty where it may be one."""
    if fit.lost:
        return "ended where the data leave parameters free"
    if fit.result in STOPPED:
        return "did not converge"
    return ""


def _white(p_values: Sequence[float]) -> bool:
    """Return whether no residual is coloured, of those that could be tested; all together reject one right model in a hundred."""
    tested = [p for p in p_values if np.isfinite(p)]
    return bool(tested) and all(p >= LEVEL / len(tested) for p in tested)
