"""`rtac study` as a user calls it."""

import sys
from pathlib import Path

import pytest
from small_study import small

sys.path.insert(0, str(Path(__file__).parents[1]))
from command_line import call, refused

sys.path.pop(0)


def test_a_study_is_run_shown_and_listed(tmp_path):
    small(repetitions=3, question="Does it run?").save(tmp_path / "little.toml")
    out = tmp_path / "little"
    ran = call("study", "run", tmp_path / "little.toml", "--out", out)
    assert ran.exit_code == 0, ran.output
    assert "3 of 3 repetitions; none failed." in ran.stdout
    assert {"report.html", "summary.csv", "repetitions.csv", "estimates.png", "pairs.svg"} <= {
        p.name for p in out.iterdir()
    }
    page = (out / "report.html").read_text()
    assert "Does it run?" in page
    assert "https://" not in page
    assert len((out / "repetitions.csv").read_text().splitlines()) == 4
    again = call("study", "run", tmp_path / "little.toml", "--out", out, "--repetitions", 5, "--chunk", 1)
    assert "5 of 5 repetitions" in again.stdout
    assert len(list((out / "chunks").iterdir())) == 3
    assert call("study", "status", out).stdout == f"{out}: small, 5 of 5 repetitions; none failed.\n"
    assert call("study", "show", out).stdout.startswith("small: Does it run?")
    listed = call("study", "list", tmp_path).stdout.splitlines()
    assert listed == [
        f"{out}: 5 of 5 repetitions; none failed. Does it run?",
        f"{tmp_path / 'little.toml'}: 3 repetitions. Does it run?",
    ]
    ready = tmp_path / "project" / "studies" / "little.toml"
    ready.parent.mkdir(parents=True)
    small(repetitions=3, question="Does it run?").save(ready)
    assert call("study", "list", tmp_path / "project").stdout == f"{ready}: 3 repetitions. Does it run?\n"


def test_wrong_use_is_refused_in_one_sentence(tmp_path):
    file, out = tmp_path / "little.toml", tmp_path / "out"
    small(repetitions=2).save(file)
    refused(call("study", "run", file, "--out", out, "--executor", "threads"), 2, "use processes or dask://ADDRESS")
    assert call("study", "run", file, "--out", out).exit_code == 0
    small(repetitions=2, seed=9).save(file)
    refused(call("study", "run", file, "--out", out), 2, "holds results of another study")
    file.write_text("name = 3\nrepetitions = 1\nestimate = []")
    refused(call("study", "run", file, "--out", out), 2, "little.toml: name: is 3")
    refused(call("study", "run", tmp_path / "none.toml"), 2, "No such file")
    refused(call("study", "show", tmp_path), 2, "holds no study")
    refused(call("study", "list", tmp_path / "none"), 2, "there is no such folder")
    assert call("study", "list", tmp_path / "out" / "chunks").stdout.endswith("there is no study here.\n")


@pytest.mark.filterwarnings("ignore")  # of dask, about the connection that fails
def test_no_scheduler_is_one_sentence(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")

    def refuses(address, timeout):
        raise OSError(f"nobody at {address}")

    monkeypatch.setattr(distributed, "Client", refuses)
    small(repetitions=2).save(tmp_path / "little.toml")
    answer = call(
        "study", "run", tmp_path / "little.toml", "--out", tmp_path / "out", "--executor", "dask://10.0.0.1:1"
    )
    refused(answer, 2, "no dask scheduler answers at tcp://10.0.0.1:1")


def test_a_damaged_study_is_named_and_hides_no_other(tmp_path):
    for name in ("one", "two"):
        small(repetitions=2).save(tmp_path / f"{name}.toml")
        assert call("study", "run", tmp_path / f"{name}.toml", "--out", tmp_path / name).exit_code == 0
    described = tmp_path / "one" / "study.toml"
    described.write_text(described.read_text()[:40])
    listed = call("study", "list", tmp_path)
    assert listed.exit_code == 0
    first, second, *_ = listed.stdout.splitlines()
    assert first.startswith(f"{described}: this is not TOML: ")
    assert second.startswith(f"{tmp_path / 'two'}: 2 of 2 repetitions")
    refused(call("study", "show", tmp_path / "one"), 2, f"{described}: this is not TOML: ")
