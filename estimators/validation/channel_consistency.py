"""Consistency of channels and experiments with the equations of motion, and the mistake that explains best why there is none."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from estimators.core.sensor_noise import noise_levels, spectral_floor
from estimators.validation.arm_kinematics import is_contradicted
from estimators.validation.cart_offset import OFFSET, of_all, of_one, offset_of_all, taken_off
from estimators.validation.equation_error import (
    COEFFICIENTS,
    Known,
    Rows,
    Solution,
    agree_beside,
    consensus,
    gaussian,
    placed,
    residual_of,
    rows_of,
    solve,
    usable,
)
from estimators.validation.equilibrium import distance_from_equilibrium
from estimators.validation.mistakes import COARSE, DELAYS, Mistake, as_well, delays, is_blurred, usual_mistakes
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Experiment, Recording, Signal, moving_at_rest

# What is undone must take nine tenths of the squared residual beyond the noise away, the fraction of the misfit from which on an
# effect explains it in a diagnosis (`DiagnosisPolicy`), to be called the mistake; and leave no more than that of the motion.
EXPLAINS = 0.1
# Times the noise from which on a residual is looked into: what weak noise and 2,000 samples leave of clean recordings is below 2.
SUSPICIOUS = 3.0
# Ratio of residuals below which two mistakes explain equally well: the standard deviation of the residual of 200 rows is 5 %, and
# that of a ratio of two is 7 %.
ALIKE = 1.15
_SEARCHED = 4  # experiments in which a mistake of all is looked for
_SURE = 3.0  # times what is asked of all, from which on two experiments settle that a mistake does not explain them
_SIGNS_OF_INPUTS = ("sign of disturbance_force", "sign of current")
_PROMISING = 0.7  # of the residual, below which a coarse delay is refined: the root of a half


@dataclasses.dataclass(frozen=True)
class Inconsistency:
    """An experiment, or all of them, that the equations of motion fit only when a mistake is undone.

    Attributes:
        experiment: its name; None for all.
        mistake: the likeliest, as `Mistake.id`.
        alike: others that explain it as well.
        before, after: residual of the equations in standard deviations of the noise: for a single experiment with it and without
            it, for all as recorded and with the mistake undone.
        sentence: that says so, and the mend.
    """

    experiment: str | None
    mistake: str
    alike: tuple[str, ...]
    before: float
    after: float
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@dataclasses.dataclass(frozen=True)
class ChannelConsistency:
    """The result of `channel_consistency`.

    Attributes:
        residual: of both equations of motion over all experiments as recorded, in standard deviations of the noise.
        each: likewise of every experiment with the coefficients of those that agree best.
        found: the inconsistencies.
    """

    residual: float
    each: Mapping[str, float]
    found: tuple[Inconsistency, ...]

    @property
    def concerns(self) -> list[str]:
        """Return one sentence for each inconsistency."""
        return [one.sentence for one in self.found]

    def __str__(self) -> str:
        if not self.each:
            return "No experiment shows enough of both equations of motion to be held against the others."
        if self.found:
            return "\n".join(self.concerns)
        return f"The equations of motion leave {self.residual:.3g} times the noise, and no usual mistake explains more than that."


@checked_arguments
def channel_consistency(recording: Recording) -> ChannelConsistency:
    """Hold channels and experiments against the equations of motion and against each other, without a fit by simulation.

    The equations are linear in the parameters and integrated against test functions, so they are solved in milliseconds, by
    coefficients none of which may be negative. Where they leave more than noise, each usual mistake is undone in turn: in all
    experiments, and in each one that the others contradict. One that takes nine tenths of the squared residual away is named.
    An offset of a cart's position shows in the mean of its equation, too, which a cart that hardly slides has as well.
    What a missing effect leaves is not: no mistake explains it.

    Args:
        recording: with moving experiments; those at rest tell the noise, unless something moves in them.

    Source: equations (1) and (2) of the paper; Shinbrot, Trans. ASME 79 (1957); Rousseeuw, J. Am. Stat. Assoc. 79 (1984).
    """
    with np.errstate(all="ignore"):  # numbers as large as 1e300 may overflow, and then they fit nothing
        return _searched(recording)


def _searched(recording: Recording) -> ChannelConsistency:
    search = _Search(recording)
    if not search.systems:
        return ChannelConsistency(0.0, {}, ())
    before = solve(list(search.systems.values()))
    # What all were recorded with shows in all; with one odd experiment besides, in those that agree.
    found = search.of_all(list(search.systems)) or search.of_all(search.inside)
    # What is wrong with all alike is undone before single ones are held against them.
    if found is not None and search.undone is not None:
        search = _Search(search.undone)
    singles = search.of_single()
    offsets = search.offsets({one.experiment for one in singles if one.experiment is not None})
    if offsets and found is None and (sign := search.sign()) is not None:
        found, offsets = sign, []
    each = {name: residual_of(rows, search.agreed.coefficients) for name, rows in search.systems.items()}
    named = tuple(one for one in (found, *offsets, *singles) if one is not None)
    return ChannelConsistency(before.residual, each, named)


class _Search:
    """The search for mistakes in one recording."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.ignored = set(moving_at_rest(recording))
        self.known = Known.of(recording.rig)
        self.levels = self._levels(recording)
        self.experiments = {e.name: e for e in usable(recording)}
        rows = {name: rows_of(e, self.levels) for name, e in self.experiments.items()}
        self.raw = {name: system for name, system in rows.items() if system is not None}
        self.systems = {name: placed(system, self.known) for name, system in self.raw.items()}
        self.inside = consensus(list(self.systems.values()))
        self.agreed = solve([self.systems[name] for name in self.inside])
        self.undone: Recording | None = None

    def _levels(self, recording: Recording) -> dict[str, float]:
        return noise_levels([e for e in recording if e.name not in self.ignored])

    def of_all(self, names: Sequence[str]) -> Inconsistency | None:
        """Return the mistake that explains what the equations leave of these experiments, if all were recorded with it."""
        if len(names) > _SEARCHED:
            # From those that the others contradict most to those that they do not.
            order = sorted(names, key=lambda name: residual_of(self.systems[name], self.agreed.coefficients))
            names = [order[round(place)] for place in np.linspace(0, len(order) - 1, _SEARCHED)]
        recorded = solve([self.systems[name] for name in names])
        as_recorded = recorded.residual
        if as_recorded < SUSPICIOUS:
            return None
        # Leaving out a few must not do better.
        enough = min(ALIKE * max(self.agreed.residual, 1.0), _explained(as_recorded))

        def score(mistake: Mistake) -> float:
            if not mistake.every:
                return np.inf
            # What two experiments contradict, more of them do not save.
            few = self._all_undone(mistake, [names[0], names[-1]]) if len(names) > 2 else None
            if few is not None and few.residual > _SURE * enough:
                return few.residual
            solution = self._all_undone(mistake, names)
            # What leaves most of the motion itself unexplained, or no motion beyond noise, is no mistake that is undone.
            if solution is None or solution.residual**2 > EXPLAINS * solution.motion**2 or solution.motion < SUSPICIOUS:
                return np.inf
            # Channels that change places change their noise, too: no more of what moves must be left than as recorded.
            return solution.residual if solution.relative <= recorded.relative else np.inf

        best = _likeliest(_scored(score, ("cart_position", "arm_velocity", "current"), as_recorded), as_recorded)
        if best is None or best[2] > enough:
            return None
        mistake, alike, after = best
        having = [name for name, e in self.experiments.items() if _undone(e, mistake) is not e]
        if mistake.undo_rig is None and len(having) == 1 and len(self.inside) < len(self.systems):
            return None  # one that the others contradict
        everywhere = mistake.undo_rig is not None or len(having) == len(self.experiments)
        self.undone = self._whole(mistake)
        return Inconsistency(
            None,
            mistake.id,
            tuple(m.id for m in alike),
            as_recorded,
            after,
            f"{'all experiments' if everywhere else ', '.join(having)}: the equations of motion leave {as_recorded:.3g} times the "
            f"noise, and {after:.3g} times if one mistake is undone: {mistake.seen}; {mistake.mend}.{as_well(alike)}",
        )

    def _whole(self, mistake: Mistake) -> Recording:
        """Return the recording with a mistake undone in all experiments."""
        rig = self.recording.rig
        if mistake.undo_rig is not None:
            return dataclasses.replace(self.recording, rig=mistake.undo_rig(rig) or rig)
        return dataclasses.replace(self.recording, experiments=tuple(_undone(e, mistake) for e in self.recording))

    def _all_undone(self, mistake: Mistake, names: Sequence[str]) -> Solution | None:
        """Return the solution of these experiments without a mistake; None where it changes nothing."""
        if mistake.undo_rig is not None:
            rig = mistake.undo_rig(self.recording.rig)
            return None if rig is None else solve([placed(self.raw[name], Known.of(rig)) for name in names])
        changed = [_undone(self.experiments[name], mistake) for name in names]
        if all(new is self.experiments[name] for new, name in zip(changed, names, strict=True)):
            return None
        others = [_undone(e, mistake) for e in self.recording if e.kind == "rest" and e.name not in self.ignored]
        levels = noise_levels([*changed, *others])
        rows = [rows_of(e, levels) for e in changed]
        return None if any(r is None for r in rows) else solve([placed(r, self.known) for r in rows if r is not None])

    @property
    def _coefficients(self) -> dict[str, float]:
        return dict(zip(COEFFICIENTS, self.agreed.coefficients, strict=True)) | dict(self.known.fixed)

    def offsets(self, others: Collection[str]) -> list[Inconsistency]:
        """Return around which other place than zero the carts move, of all experiments and of each besides others, by name."""
        if self.recording.rig.get("spring_stiffness") == 0.0:
            return []  # no spring is at rest anywhere
        off = offset_of_all(self._coefficients, list(self.experiments.values()))
        found = [] if off is None else [self._offset(None, of_all(off))]
        each = {name: e for name, e in self.experiments.items() if name not in others}
        places = {name: distance_from_equilibrium(e, self._coefficients) for name, e in each.items()}
        return found + [self._offset(name, of_one(name, off)) for name, off in places.items() if off is not None]

    def sign(self) -> Inconsistency | None:
        """Return that a sign is swapped without which no cart is off its place: a constant force is to all what an offset is."""
        before = solve(list(self.systems.values())).residual
        for mistake in (m for m in usual_mistakes() if m.id in _SIGNS_OF_INPUTS):
            having = [name for name, e in self.experiments.items() if _undone(e, mistake) is not e]
            if not having or len(having) == 1 < len(self.experiments):
                continue
            other = _Search(self._whole(mistake))
            enough, rows = ALIKE * max(before, 1.0), list(other.systems.values())
            if rows and (after := solve(rows).residual) <= enough and not other.offsets(()):
                where = "all experiments" if len(having) == len(self.experiments) else ", ".join(having)
                return Inconsistency(
                    None, mistake.id, (), before, after,
                    f"{where}: the cart is off the place where the spring is at rest, and is not if one mistake is undone: "
                    f"{mistake.seen}; {mistake.mend}. As well fits where it has none: an offset of cart_position.",
                )  # fmt: skip
        return None

    def of_single(self) -> list[Inconsistency]:
        """Return what is wrong with each experiment that the others contradict."""
        found = []
        usual = float(np.median([self.agreed.each[name] for name in self.inside]))
        worst = max(self.agreed.each[name] for name in self.inside)
        limit = SUSPICIOUS * max(usual, 1.0)
        for name in [name for name in self.systems if name not in self.inside]:
            if residual_of(self.systems[name], self.agreed.coefficients) < limit:
                continue
            if (own := self._of(name, SUSPICIOUS * max(worst, 1.0))) is not None:
                found.append(own)
        return found

    def _offset(self, name: str | None, sentence: str) -> Inconsistency:
        return Inconsistency(name, OFFSET, (), self.agreed.residual, self.agreed.residual, sentence)

    def _of(self, name: str, enough: float) -> Inconsistency | None:
        experiment = self.experiments[name]
        as_recorded = self._beside(self.systems[name])
        agreeing = [self.systems[one] for one in self.inside]

        def score(mistake: Mistake) -> float:
            changed = _undone(experiment, mistake) if mistake.single else experiment
            rows = None if changed is experiment else rows_of(changed, self._own_levels(changed))
            if rows is None:
                return np.inf
            left = self._beside(fitting := placed(rows, self.known))
            if left <= enough and not agree_beside(agreeing, self.agreed, fitting, EXPLAINS, ALIKE):
                return np.inf
            return left if left**2 <= EXPLAINS * rows.motion**2 else np.inf

        scores = _scored(score, ("cart_position", "arm_velocity", "arm_angle", "current"), as_recorded)
        offset = self._without_offset(name)
        if offset is not None and offset[1] ** 2 <= EXPLAINS * self.systems[name].motion ** 2:
            scores.append(offset)
        best = _likeliest([score for score in scores if score[1] <= enough], as_recorded)
        if best is None:
            return None
        mistake, alike, _ = best
        everything = list(self.systems.values())
        before = solve(everything).residual
        after = solve([s for s in everything if s.name != name]).residual
        # It is half of the squared residual beyond the noise; and where others do not agree to theirs, as beside a sensor's gain,
        # one that differs by a little more has no mistake of its own, and one that is no larger than they are no unit.
        if after**2 - 1.0 >= _PROMISING**2 * (before**2 - 1.0) or (
            after > SUSPICIOUS and (after > _explained(before) or not self._may_have(name, mistake))
        ):
            return None
        return Inconsistency(
            name,
            mistake.id,
            tuple(m.id for m in alike),
            before,
            after,
            f"experiment {name} disagrees with all others; leaving it out takes the residual of the equations of motion from "
            f"{before:.3g} to {after:.3g} times the noise; its {mistake.seen}: {mistake.mend}.{as_well(alike)}",
        )

    def _may_have(self, name: str, mistake: Mistake) -> bool:
        """Return whether an experiment is out of line with the others by what a mistake of a unit makes of it, to its root."""
        if mistake.scale is None:
            return True
        channel, factor = mistake.scale
        sizes = {e.name: float(np.nanstd(s.values)) for e in self.experiments.values() if (s := _signal(e, channel))}
        usual = float(np.median([size for other, size in sizes.items() if other != name] or [0.0]))
        if usual == 0:
            return True
        return bool(abs(np.log(sizes[name] / usual * factor)) < 0.5 * abs(np.log(factor)))

    def _own_levels(self, experiment: Experiment) -> dict[str, float]:
        """Return the noise levels of an experiment that may be quieter than the others, as one in a smaller unit would be.

        Otherwise everything would fit that is made small enough to vanish in the noise of the others.
        """
        return {
            channel: min(level, spectral_floor(experiment.outputs[channel].values))
            if channel in experiment.outputs
            else level
            for channel, level in self.levels.items()
        }

    def _beside(self, rows: Rows) -> float:
        """Return what an experiment adds to the residual of those that agree, by its own number of rows."""
        joint = solve([*(self.systems[name] for name in self.inside), rows])
        return gaussian(max(joint.squares - self.agreed.squares, 0.0), joint.rows - self.agreed.rows)

    def _without_offset(self, name: str) -> tuple[Mistake, float] | None:
        """Return the mistake of an offset of its own, and what it leaves."""
        rows, coefficients = self.systems[name], self.agreed.coefficients
        column = rows.matrix[:, COEFFICIENTS.index("offset")]
        of_cart = column > 0
        spring = dict(zip(COEFFICIENTS, coefficients, strict=True)) | dict(self.known.fixed)
        if not of_cart.any() or spring["spring"] <= 0:
            return None
        error = rows.target - rows.matrix @ coefficients
        push = float(np.median(error[of_cart] / column[of_cart]))
        off = -push / spring["spring"]
        mistake = Mistake(
            OFFSET,
            f"cart_position fits when {1e3 * off:.3g} mm are taken off",
            taken_off(off),
        )
        return mistake, self._beside(dataclasses.replace(rows, target=rows.target - push * column))


def _signal(experiment: Experiment, channel: str) -> Signal | None:
    return experiment.outputs.get(channel) or experiment.inputs.get(channel)


def _undone(experiment: Experiment, mistake: Mistake) -> Experiment:
    """Return an experiment without a mistake; as it is where it cannot have it, as angle and velocity of the arm tell."""
    changed = mistake.undo(experiment)
    return experiment if changed is None or is_contradicted(experiment, changed, EXPLAINS) else changed


def _scored(
    score: Callable[[Mistake], float], channels: tuple[str, ...], as_recorded: float
) -> list[tuple[Mistake, float]]:
    """Return what is left without each usual mistake, and without delays of these channels, of which first a few are tried."""
    found = [(mistake, score(mistake)) for mistake in usual_mistakes()]
    if min(least for _, least in found) < ALIKE:  # nothing but noise: no delay explains more
        return found
    for channel in channels:
        coarse = [(mistake, score(mistake)) for mistake in delays(channel, COARSE)]
        mistake, least = min(coarse, key=lambda pair: pair[1])
        # Half way to the right delay three quarters of what it costs are gone.
        if least < _PROMISING * as_recorded:
            tried = {m.id for m, _ in coarse}
            early = "-" in mistake.id.rsplit(" ", 2)[-2]
            fine = [
                m for m in delays(channel, DELAYS) if m.id not in tried and ("-" in m.id.rsplit(" ", 2)[-2]) == early
            ]
            coarse += [(m, score(m)) for m in fine]
        found += coarse
    return found


def _explained(as_recorded: float) -> float:
    """Return what may be left, in standard deviations of the noise, of a residual that is explained."""
    return float(np.sqrt(1.0 + EXPLAINS * max(as_recorded**2 - 1.0, 0.0)))


def _likeliest(
    scores: Sequence[tuple[Mistake, float]], as_recorded: float
) -> tuple[Mistake, list[Mistake], float] | None:
    """Return the mistake without which least is left, others that do as well, and what is left; None where none explains it."""
    # Below the noise one is as good as the other.
    floored = [(mistake, max(score, 1.0)) for mistake, score in scores]
    least = min((score for _, score in floored), default=np.inf)
    alike = [mistake for mistake, score in floored if score <= ALIKE * least]
    return None if not least <= _explained(as_recorded) or is_blurred(alike) else (alike[0], alike[1:], least)
