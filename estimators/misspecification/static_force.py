"""The missing force at a port of the rig as a function of one variable, with its standard deviation."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from estimators.core.threads import at_once
from estimators.misspecification.force_formulas import CurveEvidence, Formula, formulas_of
from estimators.misspecification.score_test import score_test
from estimators.prediction_error.force_probe import KNOTS, ForceProbe
from estimators.prediction_error.innovations import Innovations, Rows
from rtac_jax.effects.spline_force import PORTS, SHAPES, VARIABLES, SplineForce

SLOW = 1e-2
"""Fraction of the rms speed below which a learned friction fades."""

_APART = 0.1  # singular value over the largest, below which curves are not told apart
# As many hats as a learned force has shapes, over the whole range, as heights at the knots.
_WIDE = np.maximum(0.0, 1.0 - np.abs(np.linspace(0, SHAPES - 1, KNOTS) - np.arange(SHAPES)[:, None]))


@dataclasses.dataclass(frozen=True)
class ForceCurve:
    """The missing force at one port, as a function of one variable.

    Attributes:
        port: "cart" [N] or "arm" [N m].
        variable: of `rtac_jax.effects.spline_force.VARIABLES`.
        score: explained part of the innovations beyond chance and its price; negative for nothing.
        at: values of the variable.
        force: the missing force there.
        std: its standard deviation; infinite where the variable never was.
        explains: twice the gain in log-likelihood.
        excess: that, less what chance explains.
        p_value: of the score test, for this curve alone.
        shapes: curves that the data tell from the model's own parameters, most telling first, as heights at `at`; made of six
            wide hats where these explain more than the six most telling of twelve narrow ones.
        amounts: of each, as far as it explains more than chance.
        slow: speed below which friction fades [m/s or rad/s].
        evidence: of the heights by folds of the data, from which `formulas` are made; None where it was not kept.
    """

    port: str
    variable: str
    score: float
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    std: Float[np.ndarray, " knot"]
    explains: float
    excess: float
    p_value: float
    shapes: Float[np.ndarray, "shape knot"]
    amounts: Float[np.ndarray, " shape"]
    slow: float = 1e-4
    evidence: CurveEvidence | None = None

    def __repr__(self) -> str:
        told = f"explains {self.explains:.1f}, p = {self.p_value:.2g}, largest {np.max(np.abs(self.force)):.3g}"
        return f"ForceCurve(on the {self.port} against {self.variable}: {told})"

    def effect(self) -> SplineForce:
        """Return the missing force as an effect that can be added to the model: it makes the error fall, whatever it is.

        Its curves have no slope that a spring or viscous friction of the model has: fitted beside these, they would share it.
        """
        shapes, amounts = self.shapes[:SHAPES], self.amounts[:SHAPES]
        if (slopes := self._of_the_model()) is not None:
            shapes, amounts = _without_slopes(shapes, amounts, slopes)
        size = np.max(np.abs(shapes * amounts[:, None]), axis=1)
        size = np.where(size > 0, size, 1.0)
        between = (float(self.at[0]), float(self.at[-1]))
        # Amounts in units of what was found, so that all of them are of order one.
        return SplineForce.over(
            self.variable, between, port=self.port, shapes=shapes * size[:, None],
            amounts=amounts / size, slow=self.slow,
        )  # fmt: skip

    def _of_the_model(self) -> Float[np.ndarray, "knot slope"] | None:
        """Return the slopes at the knots that parameters of the model have; None where it has none in this variable."""
        if (self.port, self.variable) in (("cart", "cart_position"), ("cart", "cart_velocity")):
            return self.at[:, None]
        if (self.port, self.variable) == ("arm", "arm_velocity"):  # one coefficient each way
            return np.column_stack([np.maximum(self.at, 0.0), np.minimum(self.at, 0.0)])
        return None

    def formulas(self, *, most: int = 5) -> list[Formula]:
        """Propose laws for the missing force: sums of few terms with units, each ready as an effect, the best first.

        They are ranked by the likelihood of data held out of their fits. Any shape that the model's own parameters explain, such as
        a slope in the cart's position beside a spring, is left to these.

        Args:
            most: formulas to return.

        Raises:
            ValueError: the curve was made without the evidence that this needs.
        """
        if self.evidence is None:
            raise ValueError("this curve holds no evidence to make formulas of; take one that est.diagnose made.")
        return formulas_of(self.port, self.variable, self.at, self.evidence, self.slow, most=most)


def _without_slopes(
    shapes: Float[np.ndarray, "shape knot"],
    amounts: Float[np.ndarray, " shape"],
    slopes: Float[np.ndarray, "knot slope"],
) -> tuple[Float[np.ndarray, "kept knot"], Float[np.ndarray, " kept"]]:
    """Return curves that span what the shapes are beside these slopes, and the amounts that make the same force of them.

    A shape that is little more than a slope leaves next to nothing, which no fit could tell from the other shapes.
    """
    basis = np.column_stack([slopes, np.ones(len(slopes))])
    left = shapes - np.linalg.lstsq(basis, shapes.T, rcond=None)[0][:-1].T @ slopes.T
    alike = left / np.maximum(np.max(np.abs(shapes), axis=1, keepdims=True), 1e-300)
    _, size, across = np.linalg.svd(alike, full_matrices=False)
    kept = across[size > _APART * size[0]]
    return kept, kept @ (amounts @ left)


_QUARTERS = 4  # folds of a single experiment, or of two


def curve_of(
    port: str, variable: str, at: Float[np.ndarray, " knot"], rows: Rows, error: np.ndarray,
    basis: Float[np.ndarray, "row explained"],
    blocks: np.ndarray, *, folds: Sequence[slice], slow: float, count: int,
) -> ForceCurve | None:  # fmt: skip
    """Estimate a missing force of one variable; None where the data show nothing of it.

    Args:
        port: "cart" or "arm".
        variable: of `rtac_jax.effects.spline_force.VARIABLES`.
        at: knots.
        rows: what the hat at each knot takes off the error, a column each, in units of its noise.
        error: that is to be explained, without its part in the basis, in the same units.
        basis: orthonormal columns that the model's parameters explain already.
        blocks: number of the stretch of time of each row.
        folds: rows of the parts of the data by which formulas are judged.
        slow: speed below which friction fades.
        count: of the data, for the price of a parameter.
    """
    test = score_test(rows, error, basis, blocks)
    if test.freedom == 0:
        return None
    wide = score_test(rows @ _WIDE.T, error, basis, blocks)
    # What is smooth is told by fewer shapes, what is narrow by the most telling of many.
    smooth = wide.explained > np.sum(test.by_direction[:SHAPES])
    chosen, hats = (wide, _WIDE) if smooth else (test, np.eye(KNOTS))
    # An amount that explains less than chance would leaves a fit with nothing to hold it.
    told = max(1, int(np.sum(chosen.by_direction > 1.0)))
    # Directions that the base parameters explain, such as a slope, are not the data's to give.
    left = rows - basis @ (basis.T @ rows)
    pairs = [(left[fold], error[fold]) for fold in folds]
    evidence = CurveEvidence(np.stack([a.T @ a for a, _ in pairs]), np.stack([-a.T @ e for a, e in pairs]))
    return ForceCurve(
        port, variable, test.explained - test.freedom * np.log(count), at, test.coefficients, test.std,
        test.explained, test.excess, test.p_value, chosen.directions[:told] @ hats,
        chosen.amounts[:told], slow, evidence,
    )  # fmt: skip


def _folds(innovations: Innovations, error: np.ndarray) -> list[slice]:
    """Return the rows of each experiment, or of quarters of the time where there are fewer than three."""
    experiments = innovations.data.experiments
    rows = innovations.data.samples * int(innovations.used.sum())  # what follows are constants
    parts = [slice(n * rows, (n + 1) * rows) for n in range(experiments)]
    parts = [part for part in parts if np.any(error[part])]
    if len(parts) < 3:
        parts = [
            slice(int(quarter[0]), int(quarter[-1]) + 1)
            for part in parts
            for quarter in np.array_split(np.arange(part.start, part.stop), _QUARTERS)
        ]
    return parts


def force_curves(
    innovations: Innovations,
    error: np.ndarray,
    basis: Rows,
    ranges: Mapping[str, tuple[float, float]],
    slow: tuple[float, float],
) -> list[ForceCurve]:
    """Estimate the missing force at each port against each variable, with bands, best score first.

    Args:
        innovations: of the base model, with its derivatives.
        error: the innovations of the base model.
        basis: orthonormal columns that its parameters explain already.
        ranges: between which values each variable moves.
        slow: speeds of cart and arm below which friction fades.
    """
    count, blocks, folds = int(np.sum(innovations.weight > 0)), innovations.blocks(), _folds(innovations, error)

    def curve(place: tuple[int, int]) -> ForceCurve | None:
        port, variable = place
        low, high = ranges[VARIABLES[variable].split(",")[0]]
        spacing = (high - low) / (KNOTS - 1)
        rows = innovations.by_force(ForceProbe.between(port, variable, low, high, slow[port]))
        return curve_of(
            PORTS[port], VARIABLES[variable], low + spacing * np.arange(KNOTS), rows, error, basis, blocks,
            folds=folds, slow=slow[port], count=count,
        )  # fmt: skip

    found = [one for one in at_once(curve, places_of(ranges)) if one is not None]
    return sorted(found, key=lambda one: -one.score)


def places_of(ranges: Mapping[str, tuple[float, float]]) -> list[tuple[int, int]]:
    """Return the numbers of port and variable between which a force is looked for."""
    found = []
    for place, port in enumerate(PORTS):
        for index, variable in enumerate(VARIABLES):
            low, high = ranges[variable.split(",")[0]]
            rubbed = {"cart_position": "cart", "arm_angle": "arm"}
            if high > low and ("," not in variable or rubbed[variable.split(",")[0]] == port):
                found.append((place, index))
    return found
