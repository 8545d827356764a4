"""The one run of all benchmarks: sections run, and `results.json` keeps what each found with the load under which it ran."""

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
NEEDED = {
    "simulation": {"batch_512_vs_c", "single_vs_c"},
    "jacobian": {"jacobian_vs_simulation"},
    "diagnosis": {"fit_cold", "fit_warm", "diagnose_cold", "diagnose_warm", "fit_cached", "diagnose_cached"},
    "unknown": {"unknown_cold", "unknown_warm"},
    "example": {"example_cold", "example_cached"},
    "demo": {"demo_cold", "demo_cached"},
    "study": {"study_1000"},
}
"""Names of ratios and seconds that a section finds on its own."""


@pytest.fixture(scope="module")
def bench() -> Iterator[SimpleNamespace]:
    """Modules of the folder, which is no package."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import bench_fit
        import bench_simulation
        import picture
        import results_file
        import run
        import simulation_peers

        yield SimpleNamespace(
            run=run,
            file=results_file,
            picture=picture,
            fit=bench_fit,
            simulation=bench_simulation,
            peers=simulation_peers,
        )
    finally:
        sys.path.remove(str(BENCHMARKS))


def about(load: float = 1.0, others: float = 0.0) -> dict[str, Any]:
    return {
        "load": {"start": load, "end": load, "others": others}, "took": 1.0, "commit": "abc", "small": True,
        "machine": {"processor": "of a test", "cores": 2},
    }  # fmt: skip


def small(section: str, out: Path) -> dict[str, Any]:
    """Run a section with little; return what the file holds then."""
    command = [sys.executable, str(BENCHMARKS / "run.py"), "--small", "--out", str(out), "--sections", section]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert (out / "results.png").read_bytes().startswith(b"\x89PNG")
    return json.loads((out / "results.json").read_text())


def check(results: dict[str, Any], section: str) -> None:
    found = results["ratios"] | results["seconds"]
    assert found.keys() >= NEEDED.get(section, set())
    assert all(math.isfinite(value) and value > 0 for value in found.values())
    run = results["sections"][section]
    assert run["small"]
    assert run["load"].keys() == {"start", "end", "others"}
    assert results["load"].keys() == {"start", "end"}
    assert run["machine"]["cores"] >= 1


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="the floor is written in C")
def test_a_section_runs_small_and_its_numbers_are_kept(tmp_path: Path) -> None:
    results = small("simulation", tmp_path)
    check(results, "simulation")
    assert {row["name"] for row in results["sections"]["simulation"]["rows"]} >= {"NumPy RK4", "SciPy solve_ivp"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "section", ["jacobian", "fit", "growth", "diagnosis", "unknown", "example", "demo", "study", "linear", "subspace", "weight"]
)  # fmt: skip
def test_every_section_runs_small(section: str, tmp_path: Path) -> None:
    results = small(section, tmp_path)
    check(results, section)
    assert ("megabytes" in results) == (section == "diagnosis")


def test_every_benchmark_is_a_section_of_the_run(bench: SimpleNamespace) -> None:
    scripts = {command[0] for commands in bench.run.SECTIONS.values() for command in commands}
    assert scripts == {path.name for path in BENCHMARKS.glob("bench_*.py")}


def test_a_section_takes_the_place_of_its_own_numbers_only(bench: SimpleNamespace, tmp_path: Path) -> None:
    first = {"ratios": {"single_vs_c": 30.0}, "seconds": {"fit_cold": 20.0}, "megabytes": 900}
    again = {"ratios": {"single_vs_c": 5.0}, "rows": [1]}
    results = bench.file.merged({}, "diagnosis", first, about(load=0.1), load_at_start=0.1)
    assert results["quiet"]
    results = bench.file.merged(results, "simulation", again, about(load=8.0, others=1.5), load_at_start=7.0)
    assert results["ratios"] == {"single_vs_c": 5.0}
    assert results["seconds"] == {"fit_cold": 20.0}
    assert results["megabytes"] == 900
    assert results["load"] == {"start": 7.0, "end": 8.0}
    assert results["sections"]["diagnosis"]["load"]["end"] == 0.1
    assert not results["quiet"]
    file = tmp_path / "results.json"
    bench.file.write(file, results)
    assert bench.file.read(file) == results
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]
    assert "ratios.batch_512_vs_c" in bench.file.missing(results)
    assert "megabytes" not in bench.file.missing(results)
    assert "Other programs used the machine" in bench.run.summary(results)


def test_a_section_that_fails_loses_nothing_of_the_others(
    bench: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "results.json"
    bench.file.write(file, {"ratios": {"single_vs_c": 5.0}})
    (tmp_path / "broken.py").write_text("raise SystemExit('no such rig')")
    monkeypatch.setattr(bench.run, "SECTIONS", {"broken": [[str(tmp_path / "broken.py")]]})
    assert bench.run.run(["broken"], file, small=True) == ["broken"]
    assert bench.file.read(file) == {"ratios": {"single_vs_c": 5.0}}
    assert "no such rig" in capfd.readouterr().err


def test_small_numbers_do_not_take_the_place_of_real_ones(
    bench: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["run.py", "--small"])
    with pytest.raises(SystemExit):
        bench.run.main()
    assert "--small needs an --out FOLDER" in capsys.readouterr().err


def test_other_programs_are_told_from_the_own(bench: SimpleNamespace) -> None:
    others = bench.run.Others()
    sum(n * n for n in range(2_000_000))
    assert 0.0 <= others.cores() <= bench.file.machine()["cores"]


def test_fits_that_do_not_end_at_the_same_place_are_refused(bench: SimpleNamespace) -> None:
    one = bench.fit.Ended("package", "given", 1.0, 0.1, 1.0, [1.0, 2.0])
    bench.fit.require_same([one, one._replace(tool="scipy_trf", rms=1.0 + 1e-10)])
    for other in (one._replace(rms=1.001), one._replace(values=[1.0, 2.1])):
        with pytest.raises(SystemExit, match="did not solve the same problem"):
            bench.fit.require_same([one, other])


def test_ratios_are_to_the_faster_of_one_peers_methods(bench: SimpleNamespace) -> None:
    ended = bench.fit.Ended
    ends = [
        ended("package", "given", 5.0, 0.5, 1.0, []), ended("scipy_trf", "given", 2.0, 2.0, 1.0, []),
        ended("scipy_lm", "given", 2.0, 1.0, 1.0, []), ended("package", "free", 9.0, 3.0, 1.0, []), ended("scipy_trf", "free"),
    ]  # fmt: skip
    assert bench.fit.ratios(ends) == {"fit_vs_scipy_numba": 2.0}
    row = bench.peers.Row
    rows = [row(bench.simulation.OWN, 512, 26.0), row(bench.peers.C, 512, 20.0), row(bench.simulation.OWN, 1, 500.0)]
    assert bench.simulation.ratios(rows) == {"batch_512_vs_c": 1.3}


def test_what_was_measured_last_is_complete(bench: SimpleNamespace) -> None:
    results = bench.file.read(BENCHMARKS / "results.json")
    assert bench.file.missing(results) == []
    assert not any(run["small"] for run in results["sections"].values())
    assert results["sections"].keys() <= bench.run.SECTIONS.keys()


def test_a_picture_is_drawn_of_what_there_is(bench: SimpleNamespace, tmp_path: Path) -> None:
    results = bench.file.read(BENCHMARKS / "results.json")
    for sections in (results["sections"], {}):
        bench.picture.draw(results | {"sections": sections}, tmp_path / "results.png")
        assert (tmp_path / "results.png").stat().st_size > 10_000


def test_what_a_section_finds_no_more_is_kept_from_no_earlier_run(bench: SimpleNamespace) -> None:
    first = bench.file.merged({}, "fit", {"ratios": {"one": 2.0, "gone": 3.0}}, about(), load_at_start=1.0)
    other = bench.file.merged(first, "study", {"seconds": {"three": 1.0}}, about(), load_at_start=1.0)
    again = bench.file.merged(other, "fit", {"ratios": {"one": 4.0}}, about(), load_at_start=1.0)
    assert again["ratios"] == {"one": 4.0}
    assert again["seconds"] == {"three": 1.0}
