"""The equations of motion in their weak form, a cheap model: what they leave of each experiment without a fit by simulation."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from estimators.closed_form.modulating_functions import integrated_terms
from estimators.closed_form.regressors import Terms
from rtac_jax.measurement import Experiment, Recording

COEFFICIENTS = (
    "spring", "viscous", "dry", "swing", "push", "offset", "against_offset", "reaction", "current", "positive", "negative",
)  # fmt: skip
"""Coefficients of both equations divided by M+m and I+me^2: none of them is negative on any rig, and the two offsets are the
positive and the negative part of a constant force."""

# Fraction of an experiment's rows that count: the compromise between efficiency and resistance to rows that are faulty that
# Rousseeuw and Leroy, Robust Regression and Outlier Detection (1987), section 3.4, recommend for least trimmed squares.
KEPT = 0.75
# Rms of that fraction of the smallest of many Gaussian numbers of unit variance.
_GAUSSIAN_KEPT = 0.607
# Concentration steps of least trimmed squares; Rousseeuw and van Driessen, Data Min. Knowl. Discov. 12 (2006): two suffice to
# tell which start leads where, and it hardly moves after three.
_CONCENTRATIONS = 3
_ENOUGH = 300  # steps for each coefficient, where Lawson and Hanson found three to suffice
_NEAR_ZERO = 0.2  # of the fastest stretch: as `least_squares` has it for its weak form
_ROUNDING = 1e-6  # of a term: what integrals over samples lose, the curvature between them included
_LONGEST = 4096  # samples of an experiment that are looked at: minutes of a long one say nothing of units that its start does not


@dataclasses.dataclass(frozen=True)
class Rows:
    """The rows of both equations of one experiment, each divided by the standard deviation that sensor noise gives it.

    Attributes:
        name: of the experiment.
        matrix: by coefficient; the columns of known coefficients are zero.
        target: what the columns have to explain.
        motion: rms of the accelerations, or of a force that is known, whichever is larger.
    """

    name: str
    matrix: Float[np.ndarray, "row coefficient"]
    target: Float[np.ndarray, " row"]
    motion: float = 0.0


@dataclasses.dataclass(frozen=True)
class Known:
    """Constants of the rig as they enter the divided equations.

    Attributes:
        tie: I+me^2 over M+m, by which swing and reaction go together; None where one of the two is unknown.
        fixed: coefficients that are known, by name.
    """

    tie: float | None
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, rig: Mapping[str, float]) -> "Known":
        """Return what the constants of a recording fix."""
        mass, inertia, moment = (rig.get(n) for n in ("total_mass", "arm_inertia", "eccentric_moment"))
        fixed = {}
        if mass is not None:
            fixed["push"] = 1.0 / mass
            if "spring_stiffness" in rig:
                fixed["spring"] = rig["spring_stiffness"] / mass
            if moment is not None:
                fixed["swing"] = moment / mass
        if inertia is not None:
            if "torque_constant" in rig:
                fixed["current"] = rig["torque_constant"] / inertia
            if moment is not None and mass is None:
                fixed["reaction"] = moment / inertia
        return cls(inertia / mass if mass is not None and inertia is not None else None, fixed)


def usable(recording: Recording) -> list[Experiment]:
    """Return the moving experiments whose equations can be written down from what was measured, cut to a bearable length."""
    found = []
    for e in recording:
        turns = e.arm == "free"
        unseen = turns and not {"arm_velocity", "arm_angle"} & set(e.outputs)
        lost = turns and "arm_angle" not in e.outputs and e.initial_arm_angle is None
        pushed = any(signal.values.any() for signal in e.inputs.values())
        if e.kind == "rest" or (unseen and pushed) or (lost and not unseen):
            continue
        if e.cart == "free" and "cart_position" not in e.outputs:
            continue
        found.append(e if e.samples <= _LONGEST else e.cut(0, _LONGEST, e.name))
    return found


def rows_of(experiment: Experiment, levels: Mapping[str, float]) -> Rows | None:
    """Return both equations of an experiment against test functions; None where it is too short or shows none of them.

    Args:
        experiment: one of `usable`.
        levels: noise of each channel, SI units.
    """
    try:
        terms = integrated_terms(experiment, levels, near_zero=_NEAR_ZERO)
    except ValueError:
        return None
    parts = [part for part in (_cart(terms), _arm(terms)) if len(part[1])]
    if not parts:
        return None
    matrix, target = (np.concatenate(column) for column in zip(*parts, strict=True))
    good = np.isfinite(target) & np.all(np.isfinite(matrix), axis=1)
    return Rows(experiment.name, matrix[good], target[good], _rms(target[good])) if good.any() else None


def placed(rows: Rows, known: Known) -> Rows:
    """Return the rows with what is known taken out: coefficients, and that swing and reaction go together."""
    matrix, target, motion, place = rows.matrix.copy(), rows.target, rows.motion, COEFFICIENTS.index
    if known.tie is not None:
        # me / J is me / M times M / J: one unknown for both equations.
        matrix[:, place("swing")] += matrix[:, place("reaction")] / known.tie
        matrix[:, place("reaction")] = 0.0
    for name, value in known.fixed.items():
        target = target - value * matrix[:, place(name)]
        motion = max(motion, value * _rms(matrix[:, place(name)]))
        matrix[:, place(name)] = 0.0
    return Rows(rows.name, matrix, target, motion)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _cart(terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """Return q'' + spring q + viscous q' + dry sgn q' + swing (sin theta)'' - push F + offset = 0 on its sliding rows."""
    cart = terms.cart
    if not np.any(cart["spring"]):
        return np.zeros((0, len(COEFFICIENTS))), np.zeros(0)
    matrix = np.zeros((len(cart["mass"]), len(COEFFICIENTS)))
    ones = np.full(len(matrix), terms.weight)
    columns = {
        "spring": cart["spring"], "viscous": cart["viscous"], "dry": cart["dry"], "swing": cart["swing"],
        "push": -cart["force"], "offset": ones, "against_offset": -ones,
    }  # fmt: skip
    for name, column in columns.items():
        matrix[:, COEFFICIENTS.index(name)] = column
    size = _deviation(terms.noise[0], cart["mass"])
    return matrix[terms.sliding] / size, -cart["mass"][terms.sliding] / size


def _arm(terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """Return theta'' + reaction q'' cos theta - current i + positive and negative theta' = 0."""
    arm = terms.arm
    if not (terms.has_arm and terms.arm_free):
        return np.zeros((0, len(COEFFICIENTS))), np.zeros(0)
    matrix = np.zeros((len(arm["inertia"]), len(COEFFICIENTS)))
    for name in ("reaction", "current", "positive", "negative"):
        matrix[:, COEFFICIENTS.index(name)] = -arm[name] if name == "current" else arm[name]
    size = _deviation(terms.noise[1], arm["inertia"])
    return matrix / size, -arm["inertia"] / size


def _deviation(noise: float, term: np.ndarray) -> float:
    """Return the standard deviation of a term, not below what it loses by rounding where there is no noise."""
    return max(noise, _ROUNDING * float(np.sqrt(np.mean(term**2))), 1e-100)


@dataclasses.dataclass(frozen=True)
class Solution:
    """The coefficients that leave least of several experiments.

    Attributes:
        coefficients: in the order of `COEFFICIENTS`; none is negative.
        each: what they leave of each experiment, in standard deviations of the noise.
        squares: sum of the squares of the rows that count.
        rows: how many count.
        motion: root mean square of the motion of all that count; see `Rows`.
    """

    coefficients: Float[np.ndarray, " coefficient"]
    each: Mapping[str, float]
    squares: float
    rows: int
    motion: float = 0.0

    @property
    def residual(self) -> float:
        """Root mean square over all experiments, in standard deviations of the noise."""
        return gaussian(self.squares, self.rows)

    @property
    def relative(self) -> float:
        """Residual over the motion; infinite where nothing moves."""
        return self.residual / self.motion if self.motion > 0 else float("inf")


def solve(systems: Sequence[Rows]) -> Solution:
    """Fit the coefficients of several experiments by least trimmed squares without negative ones.

    In each experiment the fraction `KEPT` of the rows that fit best counts, so that a fault that lasts for a moment does not.

    Source: Rousseeuw, J. Am. Stat. Assoc. 79 (1984); Lawson and Hanson, Solving Least Squares Problems (1974), for the signs.
    """
    kept = [np.arange(len(s.target)) for s in systems]
    coefficients = np.zeros(len(COEFFICIENTS))
    if not systems:
        return Solution(coefficients, {}, 0.0, 0)
    for turn in range(_CONCENTRATIONS):
        triangles = [_triangle(s, rows) for s, rows in zip(systems, kept, strict=True)]
        coefficients = _nonnegative(np.concatenate(triangles))
        if turn < _CONCENTRATIONS - 1:
            kept = [_best(s, coefficients) for s in systems]
    each, squares, motion = {}, 0.0, 0.0
    for s, rows in zip(systems, kept, strict=True):
        motion += len(rows) * s.motion**2
        left = float(np.sum((s.target[rows] - s.matrix[rows] @ coefficients) ** 2))
        each[s.name] = gaussian(left, len(rows))
        squares += left
    count = sum(len(rows) for rows in kept)
    return Solution(coefficients, each, squares, count, float(np.sqrt(motion / count)))


def residual_of(system: Rows, coefficients: Float[np.ndarray, " coefficient"]) -> float:
    """Return what given coefficients leave of an experiment, in standard deviations of the noise."""
    rows = _best(system, coefficients)
    return gaussian(float(np.sum((system.target[rows] - system.matrix[rows] @ coefficients) ** 2)), len(rows))


def agree_beside(agreeing: Sequence[Rows], agreed: Solution, rows: Rows, explains: float, alike: float) -> bool:
    """Return whether experiments that agree do so still with one more.

    Rows that fit worst do not count, and of motors that run up and turn steadily they may be all that move.

    Args:
        agreeing: those that agree.
        agreed: their solution.
        rows: of one more.
        explains: fraction of their squared motion that may be left of it, all rows counted.
        alike: ratio of residuals within which two leave as much.
    """
    joint = solve([*agreeing, rows])
    left, usual = (
        sum(float(np.sum((s.target - s.matrix @ by) ** 2)) for s in agreeing)
        for by in (joint.coefficients, agreed.coefficients)
    )
    return left <= max(explains * sum(len(s.target) * s.motion**2 for s in agreeing), alike**2 * usual)


def consensus(systems: Sequence[Rows]) -> list[str]:
    """Return the names of the two thirds of the experiments that agree best, found by leaving out one after the other.

    Each time that one goes whose absence leaves least of the others.
    """
    inside = [(s, _triangle(s, np.arange(len(s.target)))) for s in systems]
    for _ in range(len(systems) // 3):
        costs = []
        for out in range(len(inside)):
            rest = np.concatenate([triangle for i, (_, triangle) in enumerate(inside) if i != out])
            costs.append(float(np.sum((rest[:, -1] - rest[:, :-1] @ _nonnegative(rest)) ** 2)))
        inside.pop(int(np.argmin(costs)))
    return [s.name for s, _ in inside]


def gaussian(squares: float, rows: int) -> float:
    """Return the standard deviation of which trimmed rows have this sum of squares, were they Gaussian."""
    return float(np.sqrt(squares / max(rows, 1)) / _GAUSSIAN_KEPT)


def _best(system: Rows, coefficients: np.ndarray) -> np.ndarray:
    error = np.abs(system.target - system.matrix @ coefficients)
    return np.argsort(error, kind="stable")[: max(1, int(KEPT * len(error)))]


def _triangle(system: Rows, rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor of some rows, which stands for them in every least-squares problem."""
    return np.asarray(np.linalg.qr(np.column_stack([system.matrix[rows], system.target[rows]]), mode="r"))


def _nonnegative(triangle: np.ndarray) -> np.ndarray:
    """Return the coefficients without negative ones that leave least of the last column."""
    matrix, target = triangle[:, :-1], triangle[:, -1]
    size = np.sqrt(np.sum(matrix**2, axis=0))
    size = np.where(size > 0, size, 1.0)
    reduced = np.asarray(np.linalg.qr(np.column_stack([matrix / size, target]), mode="r"))
    if not np.all(np.isfinite(reduced)):
        return np.zeros(len(size))
    return nnls(reduced[:, :-1], reduced[:, -1], maxiter=_ENOUGH * len(size))[0] / size
