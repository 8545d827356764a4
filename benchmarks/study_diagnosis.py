"""False alarms, power and confusion of the diagnosis on virtual rigs that its development never saw.

    python benchmarks/study_diagnosis.py run results.jsonl --draws 5                    # goes on where it was killed
    python benchmarks/study_diagnosis.py run results.jsonl --first 70 --draws 25 --only nothing    # more of one kind
    python benchmarks/study_diagnosis.py run results.jsonl --kinds effects outside      # these kinds of case only
    python benchmarks/study_diagnosis.py run results.jsonl --part 0/2                   # one of two processes side by side
    python benchmarks/study_diagnosis.py table results.jsonl

Rigs are drawn within 15 % around the paper's, sampled at 500 Hz with 12 bits; every rig of an odd draw is shaken by random
forces and torques. Draws 0 to 8 and 10 to 33 have been looked at in development, so draws begin at 34; of draws up to 69
the recordings with nothing hidden have been. A line of the result file is one recording: what was hidden, what was named,
what the tests said, the commit, and the error on a validation recording of the base model, of the improved model, of a
learned force where the catalogue lacks the effect, and of the best fit with the structure that the rig has; a model that
cannot be fitted has an infinite error. What random forces do to a shaken rig no model can know: "still" is how far the rig
itself moves otherwise without them, from the same start; models have their starts fitted. There base model and learned
force are also fitted by predictions one sample ahead, which random forces do not bend, and held against the second
recording without random forces: "base, still" and "learned, still". Cases named "twice the limit of" and "a third of the
limit of" hide an effect at that multiple of the detection limit which the diagnosis of the same rig states with nothing
hidden; they run once that is known.
"""

import argparse
import collections
import dataclasses
import itertools
import json
import subprocess
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

import estimators as est
import rtac_jax as rtac
from estimators._add_effect import holding
from estimators._output_error import moving
from estimators._start import scales_of
from rtac_jax import virtual_rig
from rtac_jax.effects import Effect

_COMMIT = subprocess.run(
    ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
).stdout.strip()
_SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}


@dataclasses.dataclass(frozen=True)
class Case:
    """What a rig hides and how it is recorded."""

    hidden: dict[str, Any] = dataclasses.field(default_factory=dict)
    rest: int = 1
    repeats: int = 1
    write_noise: bool = False  # of the rig without `noise_factor`
    played: Literal["foh", "bl"] | None = None


# Moderate sizes: the base model's error is at most some twenty times the noise.
EFFECTS: dict[str, Case] = {
    "cubic_spring": Case({"cubic_spring": 5e4}),
    "quadratic_spring": Case({"quadratic_spring": 600.0}),
    "force_offset": Case({"force_offset": 0.03}),
    "flexible_mode": Case({"flexible_mass": 0.08, "flexible_frequency": 37.4, "flexible_damping": 0.03}),
    "cart_quadratic_drag": Case({"cart_quadratic_drag": 2.0}),
    "cart_stribeck": Case({"cart_stribeck": 0.02, "cart_stribeck_velocity": 0.01}),
    "hysteretic_spring": Case({"hysteresis_stiffness": 20.0, "hysteresis_yield": 1e-3}),
    "end_stop": Case({"end_stop_travel": 0.012, "end_stop_stiffness": 300.0}),  # a soft bumper
    "arm_coulomb": Case({"arm_coulomb": 4e-4}),
    "arm_stribeck": Case({"arm_stribeck": 4e-4, "arm_stribeck_velocity": 1.0}),
    "arm_quadratic_drag": Case({"arm_quadratic_drag": 3e-6}),
    "cogging": Case({"cogging_torque": 4e-4, "cogging_order": 7.0, "cogging_phase": 0.7}),
    "cable_spring": Case({"cable_stiffness": 5e-5}),
    "gravity_tilt": Case({"tilt_across": 0.01}),
    "flexible_shaft": Case({"shaft_stiffness": 0.3, "shaft_damping": 2e-5}),
    "backlash": Case({"backlash": 0.1}),
    "saturation": Case({"saturation": 0.25}),
    "current_lag": Case({"current_lag": 0.01}),
    "input_delay": Case({"input_delay": 0.004}),
    "input_hold": Case(played="foh"),
    "dead_zone": Case({"dead_zone": 0.01}),
    "current_offset": Case({"current_offset": 0.005}),
    "torque_droop": Case({"torque_droop": 0.3}),
    "tacho_bias": Case({"tacho_bias": 0.2}),
    "tacho_gain": Case({"tacho_gain": 1.03}),
    "tacho_lag": Case({"tacho_lag": 0.005}),
    "tacho_ripple": Case({"tacho_ripple": 0.02, "tacho_ripple_phase": 0.7}),
    "lvdt_gain": Case({"lvdt_gain": 1.1}),
    "lvdt_offset": Case({"lvdt_offset": 2e-4}),
    "lvdt_nonlinearity": Case({"lvdt_cubic": 300.0}),
    "lvdt_lag": Case({"lvdt_lag": 0.005}),
    "lvdt_ripple": Case({"lvdt_ripple": 6e-5, "lvdt_ripple_phase": 0.7}),
    "channel_delay": Case({"channel_delay": 0.004}),
    "encoder_gain": Case({"encoder_gain": 1.01, "encoder": True}),
    "encoder_offset": Case({"encoder_offset": 0.05, "encoder": True}),
    "encoder_lag": Case({"encoder_lag": 0.005, "encoder": True}),
    "encoder_ripple": Case({"encoder_ripple": 0.005, "encoder_ripple_phase": 0.7, "encoder": True}),
}
OUTSIDE: dict[str, Case] = {
    "outside: friction along the way": Case({"friction_slope": 2.0}),
    "outside: magnetic detent": Case({"detent_force": 0.05}),
    "outside: floor vibration": Case({"vibration_force": 0.05}),
    "outside: Maxwell spring": Case({"maxwell_stiffness": 10.0}),
    "outside: eddy brake": Case({"eddy_torque": 1e-3, "eddy_velocity": 10.0}),
}
_NULL = "nothing, white noise"
NULLS: dict[str, Case] = {
    _NULL: Case(),
    "nothing, coloured noise": Case({"noise_correlation": 0.9}),
    "nothing, doubled noise": Case({"noise_factor": 2.0}),
    "nothing, white noise, no rest": Case(rest=0),
    "nothing, coloured noise, no rest": Case({"noise_correlation": 0.9}, rest=0),
    "nothing, white noise, no repeats": Case(repeats=0),
    "nothing, doubled noise, half of it stated, no rest": Case({"noise_factor": 2.0}, rest=0, write_noise=True),
    "nothing, coloured noise, no rest, no repeats": Case({"noise_correlation": 0.9}, rest=0, repeats=0),
}
_LITTLE = ", coloured noise, no rest, no repeats"
# What keeps noise from being taken for an effect must not take an effect for noise.
LITTLE: dict[str, Case] = {
    effect + _LITTLE: dataclasses.replace(case, hidden=case.hidden | {"noise_correlation": 0.9}, rest=0, repeats=0)
    for effect, case in EFFECTS.items()
}
PAIRS: dict[str, Case] = {
    f"{one} + {other}": Case(EFFECTS[one].hidden | EFFECTS[other].hidden)
    for one, other in (
        ("cubic_spring", "arm_coulomb"), ("cubic_spring", "current_lag"), ("cubic_spring", "tacho_bias"),
        ("cubic_spring", "gravity_tilt"), ("quadratic_spring", "dead_zone"), ("quadratic_spring", "cogging"),
        ("quadratic_spring", "cart_quadratic_drag"), ("flexible_mode", "arm_coulomb"), ("flexible_mode", "current_offset"),
        ("cart_quadratic_drag", "current_lag"), ("cart_quadratic_drag", "gravity_tilt"), ("cart_stribeck", "tacho_bias"),
        ("hysteretic_spring", "cogging"), ("hysteretic_spring", "input_delay"), ("arm_coulomb", "tacho_lag"),
        ("arm_quadratic_drag", "lvdt_nonlinearity"), ("cable_spring", "dead_zone"), ("gravity_tilt", "torque_droop"),
        ("saturation", "cubic_spring"), ("lvdt_lag", "arm_coulomb"),
    )
}  # fmt: skip


def _itself(size: float) -> float:
    return size


# The rig's name of what the detection limit is about, and its value for a size of the effect's main amplitude.
LIMITS: dict[str, tuple[str, Callable[[float], float]]] = {
    "cubic_spring": ("cubic_spring", _itself),
    "quadratic_spring": ("quadratic_spring", _itself),
    "cart_quadratic_drag": ("cart_quadratic_drag", _itself),
    "arm_coulomb": ("arm_coulomb", _itself),
    "arm_quadratic_drag": ("arm_quadratic_drag", _itself),
    "current_lag": ("current_lag", _itself),
    "input_delay": ("input_delay", _itself),
    "current_offset": ("current_offset", _itself),
    "torque_droop": ("torque_droop", _itself),
    "tacho_bias": ("tacho_bias", _itself),
    "tacho_gain": ("tacho_gain", lambda size: 1.0 + size),
    "tacho_lag": ("tacho_lag", _itself),
    "lvdt_nonlinearity": ("lvdt_cubic", _itself),
    "lvdt_lag": ("lvdt_lag", _itself),
    # What these change is not in proportion to their size.
    "saturation": ("saturation", lambda size: 1.0 / size),
    "backlash": ("backlash", _itself),
    "cable_spring": ("cable_stiffness", _itself),
    "dead_zone": ("dead_zone", _itself),
}
MULTIPLES = {"twice the limit of": 2.0, "a third of the limit of": 1 / 3}
KINDS = {"effects": EFFECTS, "outside": OUTSIDE, "nothing": NULLS, "pairs": PAIRS, "little": LITTLE}


def cases(draws: range, done: dict[tuple[str, int], dict], kinds: Sequence[str]) -> Iterator[tuple[str, int, Case]]:
    """Name, draw and what is hidden; detection limits last, as they ask what was found before."""
    for draw in draws:
        for kind in KINDS:
            for name, case in KINDS[kind].items() if kind in kinds else ():
                yield name, draw, case
        if "limits" not in kinds:
            continue
        limits = done.get((_NULL, draw), {}).get("limits", {})
        for (words, multiple), effect in itertools.product(MULTIPLES.items(), LIMITS):
            if effect in limits:
                field, of_size = LIMITS[effect]
                yield f"{words} {effect}", draw, Case({field: of_size(multiple * limits[effect])})


def one(name: str, draw: int, case: Case) -> dict[str, object]:
    """Record and diagnose one rig, and hold what comes of it against a second recording."""
    # A limit holds for the rig and the plans of which it was stated; the noise is another.
    seed, noise = (10 * zlib.crc32(f"{draw} {n}".encode()) for n in (_NULL if "limit of" in name else name, name))
    rig = dataclasses.replace(virtual_rig.Rig().drawn(seed), **(_SHAKEN if draw % 2 else {}), **case.hidden)
    ahead = {"sample_time": 0.002, "duration": 5.0, "played": case.played}
    plans = virtual_rig.standard_plans(seed=seed + 1, free=2, forced=4, rest=case.rest, repeats=case.repeats, **ahead)
    checks = virtual_rig.standard_plans(seed=seed + 3, free=1, forced=2, rest=1, **ahead)
    pair = [(rig, plans, noise + 2), (rig, checks, noise + 4)]
    recording, validation = virtual_rig.record_many(pair, write_noise=case.write_noise)
    began = time.perf_counter()
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, progress=False)
    seconds = time.perf_counter() - began
    models: dict[str, est.Fit | None] = {"base": fit}
    if found.additions:
        free = _with(fit.model, found.additions)
        held = holding(free, [effect.id for effect in found.additions])
        models["improved"] = _fitted(free, recording) or _fitted(held, recording)
    if name in OUTSIDE and found.curves:
        models["learned"] = _fitted(fit.model + found.curves[0].effect(), recording)
    if name in EFFECTS | PAIRS | LITTLE:
        models["structure"] = _best(fit.model, hidden_in(name), found.additions, recording)
    errors = {label: _error(model, validation) for label, model in models.items()}
    if draw % 2:
        still = dataclasses.replace(rig, **dict.fromkeys(_SHAKEN, 0.0))
        unshaken = virtual_rig.record(still, checks, seed=noise + 4)
        errors["still"] = _apart(validation, unshaken, rig)
        if "learned" in models:
            begins = {"base": fit.model, "learned": fit.model + found.curves[0].effect()}
            errors |= {f"{label}, still": _error(_foreseen(m, recording), unshaken) for label, m in begins.items()}
    return {
        "case": name,
        "draw": draw,
        "shaken": bool(draw % 2),
        "verdict": found.verdict,
        "effects": [c.id for c in found.effects],
        "steps": [effect.id for effect in found.additions],
        "groups": {c.id: c.confusable_with for c in found.effects},
        "removed": found.removed,
        "rejects": [t.test for t in found.tests if t.rejects],
        "limits": {c.id: c.detection_limit for c in found.candidates if c.testable},
        "validation": errors,
        "seconds": seconds,
        "commit": _COMMIT,
    }


def hidden_in(name: str) -> list[str]:
    """The effects that a case hides; of one with nothing hidden its name, which no effect has."""
    for words in MULTIPLES:
        name = name.removeprefix(f"{words} ")
    return name.removesuffix(_LITTLE).split(" + ")


def _with(model: rtac.RTAC, effects: Sequence[Effect]) -> rtac.RTAC:
    for effect in effects:
        model = model + effect
    return model


def _fitted(model: rtac.RTAC, recording: rtac.Recording) -> est.Fit | None:
    try:
        return est.output_error(model, recording, from_model=True, progress=False)
    except (ArithmeticError, ValueError):
        return None


def _foreseen(model: rtac.RTAC, recording: rtac.Recording) -> rtac.RTAC | None:
    """The model with its parameters from predictions one sample ahead."""
    try:
        return est.prediction_error_nonlinear(model, recording, from_model=True, progress=False).model
    except (ArithmeticError, ValueError):
        return None


def _best(model: rtac.RTAC, effects: list[str], named: Sequence[Effect], recording: rtac.Recording) -> est.Fit | None:
    """The best fit with these effects, from a few plausible shapes of each and from what a diagnosis named."""
    scales = scales_of(model, moving(recording))
    shapes = [rtac.effects.CATALOGUE[e].candidates(scales) for e in effects]
    begins = list(itertools.product(*(several[:: max(1, len(several) // 3)][:3] for several in shapes)))
    if sorted(e.id for e in named) == sorted(effects):
        begins.append(tuple(named))
    fits = [fit for begin in begins if (fit := _fitted(_with(model, begin), recording)) is not None]
    return min(fits, key=lambda fit: fit.statistics["cost"]) if fits else None


def _error(fit: est.Fit | rtac.RTAC | None, recording: rtac.Recording) -> float:
    """Largest rms error over noise of any channel; infinite where the model diverges, or was not fitted."""
    if fit is None:
        return float("inf")
    try:
        return max(e.rms_over_noise for e in est.compare(fit, recording).models[0].errors.values())
    except ArithmeticError:
        return float("inf")


def _apart(one: rtac.Recording, other: rtac.Recording, rig: virtual_rig.Rig) -> float:
    """Largest rms difference over noise of any channel of two recordings with the same noise of the sensors."""
    noise = {"cart_position": rig.position_noise, "arm_velocity": rig.velocity_noise, "arm_angle": rig.angle_noise}
    found = collections.defaultdict(list)
    for a, b in zip(one.experiments, other.experiments, strict=True):
        for channel, signal in a.outputs.items() if a.kind != "rest" else ():
            found[channel].append(signal.values - b.outputs[channel].values)
    return max(
        float(np.sqrt(np.mean(np.concatenate(d) ** 2))) / (noise[channel] * rig.noise_factor)
        for channel, d in found.items()
    )


def run(path: Path, draws: range, kinds: Sequence[str], only: str, part: tuple[int, int]) -> None:
    """Add what is missing in the result file."""
    rtac.configure()
    done = {}
    if path.exists():
        done = {(r["case"], r["draw"]): r for r in read(path)}
        if not path.read_bytes().endswith(b"\n"):
            path.write_text("".join(json.dumps(r) + "\n" for r in done.values()))  # a kill cut the last line short
    for name, draw, case in cases(draws, done, kinds):
        # What is stated for a rig and what is hidden in it then are of one part.
        share = zlib.crc32((_NULL if "limit of" in name else name).encode()) % part[1]
        if (name, draw) in done or only not in name or share != part[0]:
            continue
        try:
            result = one(name, draw, case)
        except (ArithmeticError, ValueError) as error:
            result = {"case": name, "draw": draw, "words": str(error), "verdict": "failed", "effects": [], "steps": []}
            result |= {"groups": {}, "validation": {}, "limits": {}, "seconds": 0.0, "commit": _COMMIT}
        done[name, draw] = result
        with path.open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(f"draw {draw}, {name}: {result['verdict']} {result['effects']}, {result['seconds']:.0f} s", flush=True)


def read(path: Path) -> list[dict]:
    """All complete lines; one that a kill cut short is left out."""
    found = []
    for line in path.read_text().splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


def outcome(result: dict) -> str:
    """What the verdict was worth: every effect that was hidden has to be in a group of its own."""
    truth = hidden_in(result["case"])
    if result["verdict"] not in ("missing", "ambiguous"):
        return result["verdict"]
    groups = [{step, *result["groups"][step]} for step in result["steps"]]
    fewer = min(len(groups), len(truth))
    matched = max(
        sum(one in group for one, group in zip(some, order, strict=True))
        for some in itertools.permutations(truth, fewer)
        for order in itertools.combinations(groups, fewer)
    )
    if matched < fewer or not set(truth) <= set(EFFECTS):
        return "wrong"
    if len(groups) > len(truth):
        return "right and more"
    if len(groups) < len(truth):
        return "a part"
    return "right" if all(len(group) == 1 for group in groups) else "in the group"


def table(path: Path) -> str:
    """Markdown: one row for each case, and one for each kind of case."""
    kinds = {"**every effect**": EFFECTS, "**outside**": OUTSIDE, "**nothing hidden**": NULLS, "**pairs**": PAIRS}
    kinds["**every effect, coloured noise, no rest, no repeats**"] = LITTLE
    kinds |= {f"**{words} an effect**": {f"{words} {effect}" for effect in LIMITS} for words in MULTIPLES}
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    wrong: dict[str, set[str]] = collections.defaultdict(set)
    errors: dict[str, list[dict[str, float]]] = collections.defaultdict(list)
    for result in read(path):
        for row in (result["case"], *(kind for kind, members in kinds.items() if result["case"] in members)):
            counts[row][outcome(result)] += 1
            if outcome(result) in ("wrong", "right and more", "a part"):
                wrong[row].add(" + ".join(result["effects"]))
            errors[row].append(result["validation"])
    columns = ("right", "right and more", "in the group", "a part", "unknown", "adequate", "wrong", "failed")
    lines = [
        f"| hidden | {' | '.join(columns)} | error on the second recording | named instead |",
        "|---" * (len(columns) + 3) + "|",
    ]
    for name in sorted(counts, key=lambda n: n.startswith("**")):
        cells = " | ".join(str(counts[name][c]) if counts[name][c] else "" for c in columns)
        shown = "" if name.startswith("**") else "; ".join(sorted(wrong[name]))
        lines.append(f"| {name} | {cells} | {_ratios(errors[name])} | {shown} |")
    return "\n".join(lines)


def _ratios(several: Sequence[dict[str, float]]) -> str:
    """Errors on the second recording: beside the right structure's, or of a learned force beside the base model's.

    Where random forces carry a rig away the base model may follow as well as the right structure does: "that tell" are the
    recordings on which it is a fifth worse, and only these say anything of what was added.
    """
    said = []
    if known := [one for one in several if np.isfinite(one.get("structure", np.inf))]:
        reached = np.array([one.get("improved", one["base"]) / one["structure"] for one in known])
        tell = np.array([one["base"] / one["structure"] > 1.2 for one in known])
        said.append(f"{np.median(reached):.2f}, at most {np.max(reached):.2f} of the right structure's")
        said.append(
            f"within 10 % in {np.sum(reached < 1.1)} of {len(known)}, {np.sum(reached[tell] < 1.1)} of {tell.sum()} that tell"
        )
    if lost := sum(np.isinf(one.get("structure", 0.0)) for one in several):
        said.append(f"the right structure could not be fitted in {lost}")
    for way in ("", ", still"):
        if learned := [one["learned" + way] / one["base" + way] for one in several if "learned" + way in one]:
            said.append(f"halved by a learned force{way} in {np.sum(np.array(learned) < 0.5)} of {len(learned)}")
    return "; ".join(said)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["run", "table"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--first", type=int, default=34)
    parser.add_argument("--draws", type=int, default=5)
    every = [*KINDS, "limits"]
    parser.add_argument("--kinds", nargs="+", choices=every, default=every)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--part", default="0/1", help="I/N: the Ith of N processes that share the work")
    arguments = parser.parse_args()
    if arguments.action == "run":
        part = tuple(int(n) for n in arguments.part.split("/"))
        assert len(part) == 2
        run(
            arguments.file,
            range(arguments.first, arguments.first + arguments.draws),
            arguments.kinds,
            arguments.only,
            part,
        )
    else:
        print(table(arguments.file))


if __name__ == "__main__":
    main()
