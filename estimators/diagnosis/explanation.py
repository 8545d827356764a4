"""The verdict of a diagnosis in plain words: what is missing, how sure that is, and what would make it surer."""

import math
from collections.abc import Collection, Mapping, Sequence

from estimators.core.fit import FAR, Parameter
from estimators.diagnosis.candidate import Candidate, loudest
from estimators.diagnosis.missing_force import static_force
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.removed_error import Verdict, fraction_removed
from estimators.diagnosis.step import Step
from estimators.diagnosis.verdict import Consequence
from estimators.diagnosis.wrong_constant import without_constants
from estimators.inference.simulation_residual import SHAKEN, SimulationResidual, judged_channels, random_forces
from estimators.misspecification.adequacy import AdequacyTest
from estimators.misspecification.line_classes import LineClass
from estimators.misspecification.residual_maps import Place
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.latent_force import LatentForce
from rtac_jax.measurement import Recording

AT_NOISE = "at the noise floor"
# Residual over noise from which a simulation is not at the noise: noise read off a spectrum is 0.8 to 1.1 times the truth.
_OFF_NOISE = 1.3
OF_A_LINE = (
    " Nothing but that line speaks against the model, and its simulation is left at {:.2f} times the noise: where a record at rest"
    " shows the line too it is the sensor's own, as hum, and the parameters hold."
)
OF_ROUNDING = (
    " Its simulation is left at {:.2f} times the noise, which is next to nothing but the rounding of {}; the tests take that for"
    " random noise, which it is not where a sensor moves slowly, so it may be all that they reject: record with a finer range."
)
MOVE_IT = "Drive the rig so hard that cart and arm move, or record a decay from far off."
BEGIN_ELSEWHERE = (
    "See what rtac info (channel_consistency) says of signs, units and offsets, and begin the fit elsewhere (starts of"
    " est.output_error)."
)
OF_A_DRIFT = (
    " It is as where a parameter changes while an experiment lasts, as friction of a drive that warms up: let the rig run"
    " before it is recorded, or fit shorter experiments and hold them against each other (est.constancy)."
)
OF_A_LIKELY_DRIFT = (
    " Most of it is as where a parameter changes while an experiment lasts, as friction of a drive that warms up; in decays, what"
    " grows with the amplitude looks like that, too. Let the rig run before it is recorded, or hold"
    " shorter experiments against each other (est.constancy)."
)
_NOTHING = 0.5  # gain in BIC that is told as none
_LISTED = 6  # by name, of what was not asked or could not show
_NEARLY_ALL = 0.9  # fraction of the misfit whose removal asks why the verdict is unknown even so
_LEFT_OUT = 0.02  # fraction of the samples from which it is worth a word that they do not count
_STRAYED = 3.0  # rms of what a simulation leaves over the noise, from which it is worth a word


def words(
    verdict: Verdict,
    effects: Sequence[Candidate],
    candidates: Sequence[Candidate],
    steps: Sequence[Step],
    tests: Sequence[AdequacyTest],
    left: Sequence[AdequacyTest],
    removed: float,
    curves: Sequence[ForceCurve],
    latent: Sequence[LatentForce],
    places: Sequence[Place],
    lines: Sequence[LineClass],
    simulation: SimulationResidual | None = None,
    policy: DiagnosisPolicy = STANDARD,
    consequence: Consequence | None = None,
    detectable: Sequence[Step] = (),
    floor: str = AT_NOISE,
    misfit: str = "the misfit",
    no_effect: str = "no effect of the catalogue",
) -> str:
    """Describe in a paragraph what is missing, how big, where it shows, how sure, and what would make it surer."""
    if verdict == "adequate":
        limits = sorted((c for c in candidates if c.testable), key=lambda c: c.id)
        text = ", ".join(f"{c.id} {c.limit}" for c in limits)
        blind = [c.id for c in candidates if not c.can_show and c.chi_square < policy.alarm]
        more = f" and {len(blind) - _LISTED} others" if len(blind) > _LISTED else ""
        unseen = (
            f" These data could not show {', '.join(blind[:_LISTED])}{more} at any plausible size." if blind else ""
        )
        found = simulation.words if simulation is not None and simulation.words else f"Nothing is missing {floor}."
        if detectable and consequence is not None:
            found = _of_no_consequence(detectable, candidates, consequence)
        text = f" An effect would have been found from: {text}." if text else ""
        return f"Adequate: {found[0].lower()}{found[1:]}{text}{unseen}"
    worst = next((p for p in places if p.by == "experiment"), None)
    part = next((p for p in places if p.by != "experiment" and p.excess > 1), None)
    shown = ""
    if worst is not None and worst.excess <= 1:
        shown = (
            " Predicted one sample ahead, no channel of any experiment is farther off than chance allows, as random forces can make"
            " up for what is missing: it shows in what these errors go along with, and in simulations."
        )
    elif worst is not None:
        shown = f" It shows most in {worst.channel} of {worst.label} ({worst.value:.2f} times the expected squares)"
        shown += f" and at {part.label}." if part is not None else "."
    if simulation is not None and simulation.vetoes:
        return f"Unknown: {simulation.words[0].lower()}{simulation.words[1:]}" + (
            shown if worst is not None and worst.excess > 1 else ""
        )
    if verdict == "unknown":
        return _unknown(candidates, tests, removed, curves, latent, lines, policy, no_effect) + shown
    by_id = {c.id: c for c in effects}
    sentences = []
    for step in steps:
        c = by_id[step.id]
        size = ", ".join(f"{n} = {_size(p)}" for n, p in c.parameters.items())
        if step.bic_gain <= _NOTHING:
            alone = " makes predictions one sample ahead no likelier, and simulations better"
            nothing = alone if step is steps[-1] else ", which explains nothing without what comes next"
            sentences.append(f"{step.id} ({size}){nothing}")
            continue
        sentences.append(
            f"{step.id} ({size}) gains {step.bic_gain:.0f} in BIC"
            + (
                f" and {step.held_out_gain:.0f} in the log-likelihood of data that did not help to estimate it"
                if math.isfinite(step.held_out_gain)
                else ", in one experiment only, so that no other confirms it"
            )
        )
    text = "; ".join(sentences)
    rest = [test.test for test in left if test.rejects]
    verb = "rejects" if len(rest) == 1 else "reject"
    after = f"; still, {', '.join(rest)} {verb}" if rest else ", and nothing rejects any more"
    fraction = (
        f" {'It removes' if len(steps) == 1 else 'Together they remove'} {100 * removed:.0f} % of {misfit}{after}."
    )
    if consequence is not None:
        fraction += f" The error falls by {_fall(consequence)}."
    if verdict == "missing":
        return f"Missing: {text}.{fraction}{shown} The intervals do not count that the effect was selected."
    alike, would_tell = _alike(steps)
    return f"Ambiguous: {alike}. The best fit: {text}.{fraction}{shown}{would_tell}"


def _alike(steps: Sequence[Step]) -> tuple[str, str]:
    """Say what is not told from each step, by the data or as the time was over before, and what would tell them apart."""
    told = [(step.id, [i for i in step.rivals if i not in step.late]) for step in steps]
    late = [(step.id, step.late) for step in steps]
    apart = "; ".join(f"{i} or {', '.join(rivals)}" for i, rivals in told if rivals)
    untried = "; ".join(f"{', '.join(rivals)} against {i}" for i, rivals in late if rivals)
    parts = [f"the data cannot tell {apart} apart"] if apart else []
    parts += [f"the time was over before all were held against each other, {untried}"] if untried else []
    decides = any(without_constants([one, *rivals]) for one, rivals in told if rivals)
    return ", and ".join(parts), (
        " An experiment that separates them may decide (est.next_experiment)." if decides else ""
    )


def _of_no_consequence(steps: Sequence[Step], candidates: Sequence[Candidate], consequence: Consequence) -> str:
    """Say what can be detected although the model is adequate without it."""
    by_id = {c.id: c for c in candidates}
    parts = []
    for step in steps:
        size = ", ".join(f"{n} = {_size(p)}" for n, p in by_id[step.id].parameters.items())
        parts.append(f"{' or '.join([step.id, *step.rivals])} ({size}), which gains {step.bic_gain:.0f} in BIC")
    return (
        f"What is missing is detectable, but of no consequence: {'; '.join(parts)}. With it the error would fall by "
        f"{_fall(consequence)} only."
    )


def _fall(consequence: Consequence) -> str:
    simulated = "" if consequence.simulated is None else f" and {100 * consequence.simulated:.2g} % in simulation"
    return f"{100 * consequence.predicted:.2g} % predicted one sample ahead{simulated}"


def _size(one: Parameter) -> str:
    # A deviation of zero is that of a parameter that is fixed.
    unit = "" if one.unit == "1" else f" {one.unit}"
    return f"{one.value:.4g} +- {one.std:.2g}{unit}" if one.std > 0 else f"{one.value:.4g}{unit}, fixed"


OF_PART_IN_TIME = (
    " The time was over when {:,} samples of all experiments had been looked at: what is said is of these."
)
"""The samples that there was time for."""


def of_part(samples: int, *, gross: bool, named: bool) -> str:
    """Say that only a part of the samples was looked at, as what is missing shows in it.

    Args:
        samples: that were looked at.
        gross: whether the fit follows nothing; else it misses more than the sensors do.
        named: whether they tell what is missing; else the others show nothing that could be named beside it.
    """
    why = "follows nothing" if gross else "misses more than the sensors do"
    shown = "which show what dominates" if named else "beside which the others show nothing that could be named"
    last = " What is smaller is for a diagnosis of the model with what is named." if named else ""
    return f" As the fit {why}, {samples:,} samples of all experiments were looked at, {shown}; detection limits are theirs.{last}"


def not_named(further: Sequence[Step], left: Sequence[AdequacyTest], samples: int) -> str:
    """Say what would explain a part of what the named effects leave, but too little of it."""
    first = further[0]
    fraction = fraction_removed([first], samples)
    choice = " or ".join([first.id, *first.rivals])
    return f" Of what is then left {choice} would remove {100 * fraction:.0f} %, too little to be named."


def without_alarm(effect: str, confirmed: tuple[int, ...], *, hid: bool = False) -> str:
    """Say why an effect is named whose score raised no alarm.

    Args:
        effect: id of it.
        confirmed: how many experiments confirm it, and of how many; empty where that was not asked.
        hid: whether it takes the place of large random forces.
    """
    if hid:
        return f" {effect} raised no alarm by itself: the random forces hid it whose place it takes, and what they hide was tried."
    if confirmed:
        count, of = confirmed
        return (
            f" {effect} raised no alarm by itself, as it scatters over the seconds of data: estimated from the others, {count} of"
            f" {of} experiments confirm it, and none speaks against it."
        )
    return f" {effect} raised no alarm by itself: it was tried because what did explains less, or nothing."


def out_of_time(broken_off: Sequence[str], fitted: Collection[str] = ()) -> str:
    """Say what was not asked, as the time was over.

    Args:
        broken_off: what was.
        fitted: ids of effects that were fitted before that, beside fewer others.
    """
    again = [name for name in broken_off if name in fitted]
    both = ([name for name in broken_off if name not in fitted], ""), (again, " beside what else is missing")
    parts = [f"{_listed(names)} fitted{how}" for names, how in both if names]
    return (
        f" The time that was given was over before {', and '.join(parts)}: what is said of effects holds for the others. Give more"
        " of it (within), or a part of the recording."
    )


def _listed(names: Sequence[str]) -> str:
    """Return some names with a verb in the past."""
    shown = ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
    return f"{shown} {'was' if len(names) == 1 else 'were'}"


def unconfirmed(
    candidates: Sequence[Candidate], detectable: Sequence[Candidate], policy: DiagnosisPolicy, *, thorough: bool
) -> str:
    """Say which candidate of an adequate model is as large as an alarm and scatters, so that nothing confirms it; or nothing.

    Nothing is said beside effects of no consequence, which other candidates may resemble.
    """
    first = loudest(candidates, policy)
    if first is None or detectable:
        return ""
    said = f" {first.id} reaches {first.chi_square:.0f}, the alarm is at {policy.alarm:.0f}, but scatters over the seconds of data"
    if not thorough:
        return f"{said}: a thorough diagnosis asks whether experiments confirm it."
    return f"{said}, and the experiments do not confirm it: it is chance, or these data are too few."


def surer(verdict: Verdict, recording: Recording) -> str:
    """Say what would make the verdict surer: records that this recording lacks."""
    lacking = []
    if not any(e.kind == "rest" for e in recording.experiments):
        lacking.append("a rest record of two seconds, which tells the noise and its colour apart from the motion")
    if not any(e.repeat_of for e in recording.experiments):
        lacking.append("a repeat of one experiment (repeat_of), which shows model error whatever the noise is")
    if not lacking:
        return ""
    surer = "A missing effect would show more surely" if verdict == "adequate" else "It would be surer"
    return f" {surer} with {', and '.join(lacking)}."


def at_noise(simulated: float) -> bool:
    """Return whether a simulation that leaves so many times the noise is at it."""
    return bool(simulated <= _OFF_NOISE)


def floor_of(random: float, simulated: float) -> str:
    """Return down to where nothing is missing from an adequate model: a simulation need not be at the noise.

    Args:
        random: force or torque in one sample that its predictor asks for, whichever is more, as a fraction of the rms forces.
        simulated: residual of its simulation over the noise, of the worst channel.
    """
    if random >= SHAKEN:
        return "predicted one sample ahead, which counts random forces"
    if not at_noise(simulated):
        return f"predicted one sample ahead; its simulation is left at {simulated:.3g} times the noise"
    return AT_NOISE


def shaken(
    random_force: float, random_torque: float, left_out: float, *, large: bool = False, of_the_current: bool = False
) -> str:
    """Say what random forces mean for the verdict and for the fit that follows; nothing where they are small.

    Args:
        random_force: in one sample, as a fraction of the rms force.
        random_torque: in one sample, as a fraction of the rms motor torque.
        left_out: fraction of the samples that are stick-slip ambiguous.
        large: whether they are no small disturbance any more, by `random_forces_are_large`.
        of_the_current: whether the noise of a measured current is a random torque of that size.
    """
    said = ""
    if left_out > _LEFT_OUT:
        said = (
            f" {100 * left_out:.0f} % of the samples do not count: there the cart or the arm all but rests, and what the base"
            " model takes for random forces may shake loose what dry friction holds."
        )
    if max(random_force, random_torque) < SHAKEN:
        return said
    stand = "the rig is shaken, or they stand for what sensors round off, or for something missing that is too small to tell"
    if large:
        stand = (
            "the rig is shaken hard, or they hide what is missing, as parts that hit each other, for which stated limits do not"
            " hold beside such forces"
        )
    if of_the_current:
        stand = "no more than the noise of the measured current is, so that nothing need shake the rig"
    return said + (
        f" The predictor asks for random forces even so ({random_forces((random_force, random_torque))}): {stand}. A simulation"
        " cannot follow them: est.prediction_error_nonlinear estimates parameters of such a rig, est.output_error may not."
    )


def strayed(
    residual_std: Mapping[str, float],
    noise: Mapping[str, float],
    recording: Recording,
    *,
    unfollowed: float = 0.0,
    poor: float = 0.1,
) -> str:
    """Say what it means that a simulation leaves the recording although no prediction shows why; nothing where it stays.

    Where the noise is neither stated nor recorded at rest it is taken from fast changes, and a sensor that is slow to err has more.

    Args:
        residual_std: rms that the simulation leaves, by channel.
        noise: by channel, in the same units.
        recording: that was simulated.
        unfollowed: rms error over the rms of the motion, of the channel where it is most.
        poor: fraction of the motion from which a simulation is poor.
    """
    channels, noise_known = judged_channels(residual_std, recording)
    farthest = max(channels, key=lambda c: residual_std[c] / noise[c])
    times = residual_std[farthest] / noise[farthest]
    slow = "" if noise_known else "the sensor's errors are slow, "
    if not noise_known and unfollowed > poor:
        away, slow = f"{100 * unfollowed:.0f} % of the motion away from the recording", ""
    elif times >= (_STRAYED if noise_known else FAR):
        shown = "" if noise_known else " that its fast changes show"
        away = f"{times:.0f} times the noise{shown} away from the recording ({farthest})"
    else:
        return ""
    return (
        f" Even so, the simulation of the fit is {away}: {slow}the fit ended at"
        " values that are not the best, or no simulation can follow this motion, as where an arm tumbles. Its parameters and"
        " their standard deviations are not to be trusted then; est.prediction_error_nonlinear estimates them by predictions."
    )


def _unknown(
    candidates: Sequence[Candidate],
    tests: Sequence[AdequacyTest],
    removed: float,
    curves: Sequence[ForceCurve],
    latent: Sequence[LatentForce],
    lines: Sequence[LineClass],
    policy: DiagnosisPolicy,
    no_effect: str,
) -> str:
    reasons = "; ".join(f"{test.test}: {test.words}" for test in tests if test.rejects)
    refitted = [c for c in candidates if c.refitted]
    near = max(refitted, key=lambda c: c.error_reduction) if refitted else None
    even_so = ", and what it leaves is rejected all the same" if near and near.error_reduction > _NEARLY_ALL else ""
    nearest = (
        f" The nearest, {near.id}, removes {100 * near.error_reduction:.0f} % of the misfit{even_so}." if near else ""
    )
    if removed and near and removed > near.error_reduction + 0.01:
        nearest += f" Several effects of the catalogue together remove {100 * removed:.0f} %."
    force = f" The missing force is {latent[0]}." if latent else ""
    curve, rejected = static_force(curves, tests, policy)
    if curve is not None:
        static = f" It depends most on {curve.variable} ({curve.port})."
    elif rejected:
        static = (
            " Of what predictions one sample ahead miss, a static function of position, velocity, angle or current explains less"
            " than half; a simulation may tell more of it."
        )
    else:
        static = " What is missing is no static function of position, velocity, angle or current."
    telling = min(lines, key=lambda line: line.p_value, default=None)
    if telling is not None and telling.p_value < policy.level / len(lines):
        static += (
            f" On the {telling.lines} lines of the periodic input {telling.channel} has {telling.ratio:.2g} times the power "
            f"of the noise, which shows {telling.shows}."
        )
    return f"Unknown: the model fails and {no_effect} explains it ({reasons}).{nearest}{force}{static}"
