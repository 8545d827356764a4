"""Evidence is saved, loaded and judged without a model: by its own policy as the diagnosis did, by others as far as it goes."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

import estimators as est
from estimators.diagnosis.evidence import Evidence, FittedModel, HeldOut
from estimators.diagnosis.laboratory import Archive
from estimators.diagnosis.policy import STANDARD
from estimators.misspecification.findings import Findings, RepeatTest, SpectralLine

ROOT = Path(__file__).parents[2]
KEPT = Path(__file__).parents[1] / "data" / "evidence"
# What the diagnosis of each recording said when its evidence was saved, by benchmarks/study_diagnosis.py.
VERDICTS = {
    "effect": ("missing", ["tacho_ripple"]),
    "pair": ("missing", ["torque_droop", "gravity_tilt"]),
    "outside": ("unknown", []),
    "nothing": ("adequate", []),
}
WITHOUT_JAX = """
import sys, types

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "equinox", "optimistix", "rtac_jax"):
            raise ImportError(f"a judgement imports {name}")

sys.meta_path.insert(0, Refused())
# Of the package only what holds its rooms: what it exports needs JAX.
package = types.ModuleType("estimators")
package.__path__ = [sys.argv[1]]
sys.modules["estimators"] = package
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.verdict import judge
for path in sys.argv[2:]:
    found = judge(Evidence.load(path))
    print(found.verdict, *found.effects)
assert "jax" not in sys.modules
"""


def load(name: str) -> Evidence:
    return Evidence.load(KEPT / f"{name}.json")


@pytest.mark.parametrize("name", VERDICTS)
def test_saved_evidence_is_judged_as_the_diagnosis_did(name: str) -> None:
    found = est.judge(load(name))
    assert (found.verdict, list(found.effects)) == VERDICTS[name]
    assert found.incomplete == ()


def test_judging_needs_no_jax() -> None:
    files = [str(KEPT / f"{name}.json") for name in VERDICTS]
    command = [sys.executable, "-c", WITHOUT_JAX, str(ROOT / "estimators"), *files]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    assert said.stdout.splitlines() == [" ".join([verdict, *effects]) for verdict, effects in VERDICTS.values()]


def test_evidence_is_saved_and_loaded_unchanged(tmp_path: Path) -> None:
    first = load("pair")
    model = dataclasses.replace(
        first.models[0], looseness={"tacho_bias": math.inf}, values={"tacho_bias.bias": (1 / 3, 0.0)}
    )
    findings = Findings(
        line=SpectralLine("arm_velocity", 3.0, 2.0, 1.0, 0.1),
        repeats=RepeatTest(1.0, (2.0, 3.0), 0.5, 0.1, 2, 0.3, -1.0),
    )
    whole = dataclasses.replace(
        first, models=(model, *first.models[1:]), coloured=1, findings={0: findings}, held_out={(0, 1): HeldOut((1.5,), (0.2,))}
    )  # fmt: skip
    path = whole.save(tmp_path / "evidence.json")
    assert Evidence.load(path) == whole
    assert list(tmp_path.iterdir()) == [path]
    nothing = HeldOut((math.nan,), (0.0,))
    other = dataclasses.replace(whole, held_out={(0, 1): nothing})
    assert math.isnan(Evidence.load(other.save(path)).held_out[0, 1].gain[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "no evidence of a diagnosis"),
        ("[1]", "no evidence of a diagnosis"),
        ('{"format": "rtac-evidence", "version": 99}', "version 99; this version of rtac reads 1"),
        ('{"format": "rtac-evidence", "version": 1, "evidence": {"facts": 3}}', "damaged"),
    ],
)
def test_what_is_no_evidence_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "evidence.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        Evidence.load(path)


def test_an_interrupted_save_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = load("effect").save(tmp_path / "evidence.json")
    before = path.read_bytes()

    def fails(*_: object, **__: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr(Path, "write_text", fails)
    with pytest.raises(OSError, match="no room"):
        load("pair").save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_another_policy_judges_the_same_refits() -> None:
    evidence = load("effect")
    for changed, verdict in (
        ({"bic_gain": 1e9}, "unknown"),
        ({"alarm": 1e9, "refits": 1}, "unknown"),
        ({"removed": 0.1}, "missing"),
    ):
        assert est.judge(evidence, dataclasses.replace(STANDARD, **changed)).verdict == verdict, changed
    assert est.judge(evidence).verdict == "missing"


def test_a_policy_that_asks_for_what_was_not_computed_says_so() -> None:
    evidence = load("nothing")
    assert est.judge(evidence).incomplete == ()
    found = est.judge(evidence, dataclasses.replace(STANDARD, alarm=0.1, chance=1.0))
    assert any("refit of" in missing for missing in found.incomplete)
    colour = est.judge(evidence, dataclasses.replace(STANDARD, colour_little=0.5))
    assert colour.incomplete == ("noise with another colour_little",)
    shown = est.judge(evidence, dataclasses.replace(STANDARD, testable=5.0))
    assert shown.incomplete == ("candidates with another testable",)


def test_what_a_model_diverged_with_is_not_missing_from_the_evidence() -> None:
    evidence = load("effect")
    refit = next(one for one in evidence.refits if one.way == "filter")
    diverged = dataclasses.replace(refit, after=None)
    archive = Archive(dataclasses.replace(evidence, refits=(diverged,)))
    (score,) = [s for s in evidence.findings[refit.before].scores if (s.id, s.shape) == (refit.effect, refit.shape)]
    assert archive.refits(archive.base, [score], "filter") == {}
    assert archive.missing == []
    assert archive.refits(archive.base, [score], "thorough") == {}
    assert archive.missing == [f"thorough refit of {refit.effect} to the model with nothing added"]


def test_every_refit_is_recorded_with_what_a_judgement_asks_of_it() -> None:
    for name in VERDICTS:
        evidence = load(name)
        numbers = [model.number for model in evidence.models]
        assert numbers == list(range(len(numbers)))
        for model in evidence.models:
            assert isinstance(model, FittedModel)
            assert set(model.looseness) == set(model.added)
            assert len(model.by_stretch) == evidence.facts.seconds
        for one in evidence.refits:
            after = None if one.after is None else evidence.models[one.after]
            change = {one.effect} if after is not None else set()
            assert after is None or set(after.added) ^ set(evidence.models[one.before].added) == change
        assert json.loads((KEPT / f"{name}.json").read_text())["version"] == 1
