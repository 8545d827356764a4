"""Sparse regression of a missing force: sums of few terms that a curve is made of, ranked by held-out likelihood."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from estimators.core.fit import Parameter
from rtac_jax.effects.formula_force import FormulaForce, Term, formula_class
from rtac_jax.parameters import declarations

_MOST_TERMS = 3  # more describe a curve of twelve knots rather than a law
_TRIED = 15  # candidates of each number of terms, the best on all data, that are fitted in full
_TOLD = 2.0  # standard deviations from zero that every coefficient has to be
_NEARLY = 0.9  # of what the best formula gains, from which a simpler one is told, too
_SEEN = 1e-6  # information on a term, relative to the largest, below which the model's own parameters explain it
_ALIKE = 0.9999  # correlation of two terms from which they are one
_TOGETHER = 1e-9  # smallest eigenvalue of the correlations of terms, from which on they are told apart at all
_SHAPES = (0.05, 0.1, 0.2, 0.4, 0.8)  # scales of saturations and peaks, over the range of the variable
_PERIODS = (
    0.25,
    0.35,
    0.5,
    0.7,
    1.0,
    1.4,
)  # of sines and cosines, over the range of the variable; two knots make no period
_FINE = 20  # points between knots, over which a term is projected on the curve's hats
_TURN_NUMBERS = 5  # sin(n theta) and cos(n theta) up to this n, which twelve knots in a turn still show


@dataclass(frozen=True)
class CurveEvidence:
    """The evidence of the data on a curve, each fold of them apart.

    Attributes:
        information: on the heights at the knots, the model's own parameters projected away.
        score: slope of the log-likelihood by the heights, at no force.
    """

    information: Float[np.ndarray, "fold knot knot"]
    score: Float[np.ndarray, "fold knot"]


@dataclass(frozen=True)
class Formula:
    """A law that would explain a missing force.

    Attributes:
        text: the formula, with its values and units.
        effect: ready to be added to a model: `model + formula.effect`.
        parameters: value, standard deviation and unit of each parameter of the effect.
        held_out: gain in log-likelihood on data that took no part in its fit, summed over the folds.
        explained: fraction of what the curve explains that the formula does [1].
        between: range of the variable in which it was seen, SI units.
    """

    text: str
    effect: FormulaForce
    parameters: Mapping[str, Parameter]
    held_out: float
    explained: float
    between: tuple[float, float]

    def __str__(self) -> str:
        rows = [
            f"{self.text}   (held-out log-likelihood {self.held_out:+.1f}, {100 * self.explained:.0f} % of the curve, seen "
            f"from {self.between[0]:.3g} to {self.between[1]:.3g})"
        ]
        rows += [f"  {name:14s} {p.value:12.5g} ± {p.std:.2g} {p.unit}" for name, p in self.parameters.items()]
        return "\n".join(rows)


def formulas_of(
    port: str, variable: str, at: Float[np.ndarray, " knot"], evidence: CurveEvidence, slow: float, *, most: int = 5
) -> list[Formula]:
    """Propose sums of powers, signs, saturations, peaks, sines and cosines for a missing force, the best first.

    All subsets of up to three terms are regressed on the curve, weighted by the inverse of its covariance, which is singular
    where the model's own parameters explain a shape: what these take up of a term costs nothing and tells nothing.
    Scales and wave numbers are refined by Nelder and Mead's search. What a formula gains on each fold of the data when it is
    fitted to the others ranks them; one with a coefficient that is not told from zero is left out, and so is one that says the same
    with more terms. The simplest that gains nine tenths of what the best does is among them: a curve is made beside a model that
    lacks the force, and terms more may describe what that does to it.

    Args:
        port: "cart" or "arm".
        variable: of `rtac_jax.effects.spline_force.VARIABLES`.
        at: knots of the curve.
        evidence: of its heights.
        slow: speed below which friction fades.
        most: formulas to return.

    Source: sparse regression as in Brunton, Proctor and Kutz, PNAS 113 (2016), with all subsets instead of thresholds.
    """
    information, score = np.sum(evidence.information, axis=0), np.sum(evidence.score, axis=0)
    library = _library(variable, at, slow, information)
    whole = float(score @ np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ score)
    columns = _heights(at, [term.value(_fine(at), shape, slow) for term, shape in library])
    gram, right = columns @ information @ columns.T, columns @ score
    size = np.sqrt(np.diagonal(gram))
    gram, right = gram / np.outer(size, size), right / size
    found = []
    for count in range(1, _MOST_TERMS + 1):
        several = [
            s for s in itertools.combinations(range(len(library)), count)
            if all(abs(gram[a, b]) < _ALIKE for a, b in itertools.combinations(s, 2))
        ]  # fmt: skip
        if not several:
            continue
        index = np.array(several)
        # Three may say together what no two of them do.
        index = index[np.linalg.eigvalsh(gram[index[:, :, None], index[:, None, :]])[:, 0] > _TOGETHER]
        if not len(index):
            continue
        blocks, sides = gram[index[:, :, None], index[:, None, :]], right[index]
        gains = np.einsum("si,si->s", sides, np.linalg.solve(blocks, sides[:, :, None])[:, :, 0])
        for number in np.argsort(-gains)[:_TRIED]:
            chosen = [library[i] for i in index[number]]
            one = _formula(port, variable, at, evidence, slow, chosen, whole)
            if one is not None:
                found.append(one)
    ranked: list[Formula] = []
    for one in sorted(found, key=lambda f: -f.held_out):
        terms = set(one.effect.terms)
        if not any(set(better.effect.terms) <= terms for better in ranked):
            ranked.append(one)
    simplest = _simplest(found)
    if simplest is not None and all(one is not simplest for one in ranked[:most]):
        return [*ranked[: most - 1], simplest]
    return ranked[:most]


def _simplest(found: Sequence[Formula]) -> Formula | None:
    """Return the formula of fewest terms that gains nearly as much on held-out data as the best; None where none gains."""
    most = max((one.held_out for one in found), default=0.0)
    near = [one for one in found if one.held_out >= _NEARLY * most > 0]
    return min(near, key=lambda one: (len(one.effect.terms), -one.held_out), default=None)


def _fine(at: np.ndarray) -> np.ndarray:
    return np.linspace(at[0], at[-1], _FINE * (len(at) - 1) + 1)


def _heights(at: np.ndarray, values: Sequence[np.ndarray]) -> Float[np.ndarray, "term knot"]:
    """Return heights at the knots of the piecewise linear curves nearest to functions on the fine grid.

    Values at the knots alone would lie off by the curvature between them, on one side.
    """
    fine = np.linspace(0, len(at) - 1, _FINE * (len(at) - 1) + 1)
    hats = np.maximum(0.0, 1.0 - np.abs(fine[:, None] - np.arange(len(at))))
    return np.linalg.lstsq(hats, np.array(values).T, rcond=None)[0].T


def _library(variable: str, at: np.ndarray, slow: float, information: np.ndarray) -> list[tuple[Term, float]]:
    """Return the terms that the data can tell from the model's own parameters, with shapes to begin from."""
    span = float(np.max(np.abs(at)))
    base, level = variable.split(",")[0], "," in variable
    found = [(Term("power", n), 1.0) for n in range(6)] + [(Term("odd", n), 1.0) for n in (2, 4)]
    found += [] if level else [(Term("sign"), 1.0)]
    found += [(Term(kind), fraction * span) for kind in ("saturation", "peak") for fraction in _SHAPES]
    if base == "arm_angle":
        found += [(Term(kind, n), 1.0) for kind in ("sine", "cosine") for n in range(1, _TURN_NUMBERS + 1)]
    else:
        width = float(at[-1] - at[0])
        found += [(Term(kind), 2 * np.pi / (fraction * width)) for kind in ("sine", "cosine") for fraction in _PERIODS]

    def seen(one: tuple[Term, float]) -> float:
        column = _heights(at, [one[0].value(_fine(at), one[1], slow)])[0]
        return float(column @ information @ column / (column @ column))

    sizes = [seen(one) for one in found]
    return [one for one, size in zip(found, sizes, strict=True) if size > _SEEN * max(sizes)]


def _formula(
    port: str, variable: str, at: np.ndarray, evidence: CurveEvidence, slow: float, chosen: Sequence[tuple[Term, float]],
    whole: float,
) -> Formula | None:  # fmt: skip
    """Fit a formula to all folds and to all but each; None where a coefficient is not told from zero."""
    terms = tuple(term for term, _ in chosen)
    begin = np.array([shape for term, shape in chosen if term.shaped])
    information, score = np.sum(evidence.information, axis=0), np.sum(evidence.score, axis=0)

    fine = _fine(at)
    projection = _heights(at, list(np.eye(len(fine)))).T  # of all functions on the fine grid

    def columns(shapes: np.ndarray) -> np.ndarray:
        left = iter(shapes)
        return np.array([projection @ term.value(fine, next(left) if term.shaped else 1.0, slow) for term in terms])

    def solved(shapes: np.ndarray, within: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, float]:
        rows = columns(shapes)
        size = np.sqrt(np.maximum(np.einsum("tk,kl,tl->t", rows, within, rows), 1e-300))
        gram, right = (rows @ within @ rows.T) / np.outer(size, size), rows @ slope / size
        coefficients = np.linalg.solve(gram + 1e-12 * np.eye(len(gram)), right)
        return coefficients / size, float(coefficients @ right)

    def best(within: np.ndarray, slope: np.ndarray, start: np.ndarray) -> np.ndarray:
        if not len(start):
            return start
        reach = np.log(3.0)  # beyond it another start of the library is nearer
        found = minimize(
            lambda x: -solved(start * np.exp(np.clip(x, -reach, reach)), within, slope)[1], np.zeros(len(start)),
            method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3, "maxiter": 40 * len(start)},
        )  # fmt: skip
        return start * np.exp(np.clip(found.x, -reach, reach))

    shapes = best(information, score, begin)
    coefficients, gain = solved(shapes, information, score)
    names, values = [], []
    left = iter(shapes)
    for place, (term, value) in enumerate(zip(terms, coefficients, strict=True), 1):
        names.append(f"coefficient_{place}")
        values.append(float(value))
        if term.shaped:
            names.append(f"shape_{place}")
            values.append(float(next(left)))
    std = _deviations(terms, at, slow, names, np.array(values), information)
    if std is None or any(abs(v) < _TOLD * s for v, s in zip(values, std, strict=True)):
        return None
    held_out = 0.0
    for within, slope in zip(evidence.information, evidence.score, strict=True):
        inner = best(information - within, score - slope, shapes)
        heights = solved(inner, information - within, score - slope)[0] @ columns(inner)
        held_out += float(slope @ heights - 0.5 * heights @ within @ heights)
    kind = formula_class(port, variable, terms, slow)
    effect: Any = kind(**dict(zip(names, values, strict=True)))
    from_declared = _units(kind)
    parameters = {
        name: Parameter(value, float(s), from_declared[name]) for name, value, s in zip(names, values, std, strict=True)
    }
    return Formula(
        formula_text(kind, parameters),
        effect,
        parameters,
        held_out,
        gain / max(whole, 1e-300),
        (float(at[0]), float(at[-1])),
    )


def _deviations(
    terms: Sequence[Term],
    at: np.ndarray,
    slow: float,
    names: Sequence[str],
    values: np.ndarray,
    information: np.ndarray,
) -> np.ndarray | None:
    """Return standard deviations of all parameters from the curve's information; None where these are not determined."""

    def heights(theta: np.ndarray) -> np.ndarray:
        told = dict(zip(names, theta, strict=True))
        parts = [
            told[f"coefficient_{n}"] * term.value(_fine(at), told.get(f"shape_{n}", 1.0), slow)
            for n, term in enumerate(terms, 1)
        ]
        return _heights(at, [np.sum(parts, axis=0)])[0]

    step = 1e-5 * np.abs(values) + 1e-300
    slopes = np.array([(heights(values + d) - heights(values - d)) / (2 * d.sum()) for d in np.diag(step)])
    within = slopes @ information @ slopes.T
    size = np.sqrt(np.diagonal(within))
    if not np.all(size > 0):
        return None
    scaled = within / np.outer(size, size)
    if np.linalg.cond(scaled) > 1e10:
        return None
    return np.sqrt(np.diagonal(np.linalg.inv(scaled))) / size


def _units(kind: type[FormulaForce]) -> dict[str, str]:
    return {name: declared.unit for name, declared in declarations(kind).items()}


def formula_text(kind: type[FormulaForce], parameters: Mapping[str, Parameter]) -> str:
    """Return a law with the values and units of its parameters."""
    unit = "N" if kind.port == "cart" else "N m"
    told = kind.equation
    for name, p in parameters.items():
        letter, place = name.split("_")
        kinds = ("c",) if letter == "coefficient" else ("s", "k")
        for symbol in kinds:
            told = told.replace(f"{symbol}_{place}", f"({p.value:.4g} {p.unit})")
    return f"force on the {kind.port} [{unit}] = {told}"
