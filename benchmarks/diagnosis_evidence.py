"""Evidence of diagnoses of virtual rigs, kept as files to be judged again, and what came of each protocol of recording."""

import collections
import dataclasses
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from diagnosis_cases import KINDS, Case, cases, drawn, kind_of, outcome
from diagnosis_hard_cases import HARD, HardCase, recording_of
from diagnosis_protocols import PROTOCOLS, Protocol, plans_of, recorded

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.verdict import judge


def keep(
    directory: Path, draws: range, kinds: Sequence[str], only: str, part: tuple[int, int], names: Sequence[str]
) -> None:
    """Diagnose what has no evidence yet, one kind of case and one protocol after the other, and print each verdict."""
    rtac.configure()
    several = [(p, *one) for p in names for one in cases(draws, {}, kinds) if only in one[0]]
    hard = {name: case for kind in kinds for name, case in HARD.get(kind, {}).items() if only in name}
    several += [("usual", name, draw, case) for draw in draws for name, case in hard.items()]
    for protocol, name, draw, case in sorted(several, key=lambda one: zlib.crc32(" ".join(map(str, one[:3])).encode())):
        path = evidence_path(folder_of(directory, protocol), name, draw)
        if path.exists() or zlib.crc32(f"{protocol} {name}".encode()) % part[1] != part[0]:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        try:
            evidence_of(name, draw, case, PROTOCOLS[protocol]).save(path)
        except (ArithmeticError, ValueError) as error:
            print(f"{protocol}, draw {draw}, {name}: failed: {error}", flush=True)
            continue
        found, took = judge(Evidence.load(path)), time.perf_counter() - began
        print(f"{protocol}, draw {draw}, {name}: {found.verdict} {list(found.effects)}, {took:.0f} s", flush=True)


def evidence_of(name: str, draw: int, case: Case, protocol: Protocol) -> Evidence:
    """The evidence of the diagnosis of one rig."""
    seed = 10 * zlib.crc32(f"{draw} {name}".encode())
    if isinstance(case, HardCase):
        return _evidence(recording_of(case, seed, draw))
    # What is hidden comes last: a protocol may not take it away.
    rig = dataclasses.replace(drawn(case, seed, draw), **{**protocol.sensors, **case.hidden})
    plans = plans_of(protocol, seed=seed + 1, rest=case.rest, repeats=case.repeats, played=case.played)
    return _evidence(recorded(protocol, rig, plans, seed=seed + 2, write_noise=case.write_noise))


def _evidence(recording: rtac.Recording) -> Evidence:
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, progress=False).evidence
    assert found is not None
    return found


def folder_of(directory: Path, protocol: str) -> Path:
    """Return the folder of a protocol's evidence; of the usual one, that which holds the others' folders."""
    return directory if protocol == "usual" else directory / protocol.replace(", ", "_").replace(" ", "_")


def by_protocol(directory: Path) -> str:
    """Markdown: one row a protocol and kind of case, with how often each outcome came."""
    columns = ("right", "right and more", "in the group", "a part", "unknown", "adequate", "wrong")
    lines = [
        f"| protocol | hidden | recordings | {' | '.join(columns)} | named instead |",
        "|---" * (len(columns) + 4) + "|",
    ]
    for protocol in PROTOCOLS:
        counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
        wrong: dict[str, list[str]] = collections.defaultdict(list)
        for (name, _), evidence in evidence_in(folder_of(directory, protocol)).items():
            found = judge(evidence)
            said = worth_of(name, found.verdict, found.effects, found.rivals, protocol=protocol)
            counts[kind_of(name)][said] += 1
            if said in ("wrong", "right and more"):
                wrong[kind_of(name)].append(f"{', '.join(found.effects)} for {name}")
        for kind, several in counts.items():
            cells = " | ".join(str(several[c] or "") for c in columns)
            lines.append(f"| {protocol} | {kind} | {several.total()} | {cells} | {'; '.join(wrong[kind])} |")
    return "\n".join(lines)


def evidence_path(directory: Path, name: str, draw: int) -> Path:
    """Return the file of one recording's evidence."""
    return directory / f"{draw:03d} {name.replace(':', '')}.json".replace(" ", "_")


def evidence_in(directory: Path) -> dict[tuple[str, int], Evidence]:
    """Return all evidence that is kept, by case and draw."""
    known = {evidence_path(directory, name, 0).name[3:]: name for members in KINDS.values() for name in members}
    known |= {evidence_path(directory, name, 0).name[3:]: name for members in HARD.values() for name in members}
    return {
        (known[path.name[3:]], int(path.name[:3])): Evidence.load(path)
        for path in sorted(directory.glob("*.json"))
        if path.name[3:] in known
    }


class Recorded(NamedTuple):
    """A recording: the case of a draw by a protocol."""

    name: str
    draw: int
    protocol: str = "usual"


def evidence_of_protocols(directory: Path) -> dict[Recorded, Evidence]:
    """Return all evidence that is kept in a folder and in those of other protocols below it."""
    return {
        Recorded(name, draw, protocol): one
        for protocol in PROTOCOLS
        for (name, draw), one in evidence_in(folder_of(directory, protocol)).items()
    }


def worth_of(
    name: str, verdict: str, effects: Sequence[str], rivals: dict[str, tuple[str, ...]], *, protocol: str = "usual"
) -> str:
    """Return the outcome of a judgement against what is hidden in a case, and by the protocol itself."""
    chosen = PROTOCOLS[protocol]
    return outcome(as_result(name, verdict, effects, rivals), chosen.also, chosen.stands_for)


def as_result(name: str, verdict: str, effects: Sequence[str], rivals: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    """Return a judgement as `outcome` asks for it."""
    return {"case": name, "verdict": verdict, "steps": list(effects), "groups": rivals}
