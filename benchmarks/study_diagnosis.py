"""False alarms, power and confusion of the diagnosis on virtual rigs that its development never saw.

    python benchmarks/study_diagnosis.py run results.jsonl --draws 5                    # goes on where it was killed
    python benchmarks/study_diagnosis.py run results.jsonl --first 70 --draws 25 --only nothing    # more of one kind
    python benchmarks/study_diagnosis.py run results.jsonl --kinds effects outside      # these kinds of case only
    python benchmarks/study_diagnosis.py run results.jsonl --part 0/2                   # one of two processes side by side
    python benchmarks/study_diagnosis.py run --evidence DIR --first 96 --draws 2    # fit, diagnose, keep the evidence only
    python benchmarks/study_diagnosis.py run --evidence DIR --protocol all --kinds effects nothing --draws 1
    python benchmarks/study_diagnosis.py protocols --evidence DIR
    python benchmarks/study_diagnosis.py table results.jsonl
    python benchmarks/study_diagnosis.py table benchmarks/diagnosis.jsonl               # from draw 34 on

Rigs are drawn within 15 % around the paper's, sampled at 500 Hz with 12 bits; every rig of an odd draw is shaken by
random forces and torques. Where rotor and arm move apart, the rotor's share of the inertia is drawn too (0.3 for all up
to draw 33). Draws 0 to 8 and 10 to 33 have been looked at in development, so draws begin at 34; of draws up to 94 the
recordings with nothing hidden have been. A line of the result file is one recording: what was hidden, what was named,
what the tests said, the commit, and the error on a validation recording of the base model, of the improved model, of a
learned force where the catalogue lacks the effect, and of the best fit with the structure that the rig has; a model
that cannot be fitted has an infinite error. What random forces do to a shaken rig no model can know: "still" is how far
the rig itself moves otherwise without them, from the same start; models have their starts fitted. There base model and
learned force are also fitted by predictions one sample ahead, which random forces do not bend, and held against the
second recording without random forces: "base, still" and "learned, still". Cases named "twice the limit of" and "a
third of the limit of" hide an effect at that multiple of the detection limit which the diagnosis of the same rig states
with nothing hidden; they run once that is known.

With `--evidence` no second recording is made: the evidence of every diagnosis is kept as a file, all kinds of case in
turn, to be judged again by any policy (benchmarks/ablate_policy.py). `--protocol` records otherwise, as one of
diagnosis_protocols.py or as all of them, each in a folder of its own; `protocols` prints what came of them.
"""

import argparse
import collections
import dataclasses
import itertools
import json
import subprocess
import time
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from diagnosis_cases import (
    EFFECTS,
    KINDS,
    LIMITS,
    LITTLE,
    MULTIPLES,
    NULL,
    NULLS,
    OUTSIDE,
    PAIRS,
    SHAKEN,
    Case,
    cases,
    drawn,
    hidden_in,
    outcome,
)  # fmt: skip
from diagnosis_evidence import by_protocol, keep
from diagnosis_hard_cases import HARD
from diagnosis_protocols import PROTOCOLS

import estimators as est
import rtac_jax as rtac
from estimators.core.data import moving
from estimators.core.initial_state import scales_of
from estimators.diagnosis.model_extension import holding
from rtac_jax import virtual_rig
from rtac_jax.effects import Effect

_COMMIT = subprocess.run(
    ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
).stdout.strip()


def one(name: str, draw: int, case: Case) -> dict[str, object]:
    """Record and diagnose one rig, and hold what comes of it against a second recording."""
    # A limit holds for the rig and the plans of which it was stated; the noise is another.
    seed, noise = (10 * zlib.crc32(f"{draw} {n}".encode()) for n in (NULL if "limit of" in name else name, name))
    rig = drawn(case, seed, draw)
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
        still = dataclasses.replace(rig, **dict.fromkeys(SHAKEN, 0.0))
        unshaken = virtual_rig.record(still, checks, seed=noise + 4)
        errors["still"] = _apart(validation, unshaken, rig)
        if "learned" in models:
            begins = {"base": fit.model, "learned": fit.model + found.curves[0].effect()}
            errors |= {f"{label}, still": _error(_predicting(m, recording), unshaken) for label, m in begins.items()}
    return {
        "case": name,
        "draw": draw,
        "shaken": bool(draw % 2),
        "verdict": found.verdict,
        "effects": [c.id for c in found.effects],
        "detectable": [c.id for c in found.detectable],
        "steps": [effect.id for effect in found.additions],
        "groups": {c.id: c.confusable_with for c in found.effects},
        "removed": found.removed,
        "rejects": [t.test for t in found.tests if t.rejects],
        "limits": {c.id: c.detection_limit for c in found.candidates if c.testable},
        "validation": errors,
        "seconds": seconds,
        "commit": _COMMIT,
    }


def _with(model: rtac.RTAC, effects: Sequence[Effect]) -> rtac.RTAC:
    for effect in effects:
        model = model + effect
    return model


def _fitted(model: rtac.RTAC, recording: rtac.Recording) -> est.Fit | None:
    try:
        return est.output_error(model, recording, from_model=True, progress=False)
    except (ArithmeticError, ValueError):
        return None


def _predicting(model: rtac.RTAC, recording: rtac.Recording) -> rtac.RTAC | None:
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
        share = zlib.crc32((NULL if "limit of" in name else name).encode()) % part[1]
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
        shown = f", detectable {result['detectable']}" if result.get("detectable") else ""
        print(
            f"draw {draw}, {name}: {result['verdict']} {result['effects']}{shown}, {result['seconds']:.0f} s",
            flush=True,
        )


def read(path: Path) -> list[dict]:
    """All complete lines; one that a kill cut short is left out."""
    found = []
    for line in path.read_text().splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


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
    parser.add_argument("action", choices=["run", "table", "protocols"])
    parser.add_argument("file", type=Path, nargs="?", help="of results; not with --evidence")
    parser.add_argument("--evidence", type=Path, metavar="DIR", help="keep the evidence of every recording here")
    parser.add_argument(
        "--protocol",
        nargs="+",
        choices=[*PROTOCOLS, "all"],
        default=["usual"],
        help="with --evidence: how rigs are recorded",
    )
    parser.add_argument("--first", type=int, default=34)
    parser.add_argument("--draws", type=int, default=5)
    every = [*KINDS, "limits"]
    parser.add_argument(
        "--kinds", nargs="+", choices=[*every, *HARD], default=every, help="the last four with --evidence"
    )
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--part", default="0/1", help="I/N: the Ith of N processes that share the work")
    arguments = parser.parse_args()
    if (arguments.file is None) == (arguments.evidence is None) or (arguments.evidence and arguments.action == "table"):
        parser.error("give a file of results, or with run --evidence DIR.")
    if arguments.action == "protocols":
        print(by_protocol(arguments.evidence))
    elif arguments.evidence is not None:
        first, count = (int(n) for n in arguments.part.split("/"))
        draws = range(arguments.first, arguments.first + arguments.draws)
        kinds = [kind for kind in arguments.kinds if kind != "limits"]
        names = list(PROTOCOLS) if "all" in arguments.protocol else arguments.protocol
        keep(arguments.evidence, draws, kinds, arguments.only, (first, count), names)
    elif arguments.action == "run":
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
