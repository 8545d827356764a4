"""Studies end, go on, and give the same bits, whatever happens to the processes that compute them."""

import contextlib
import dataclasses
import errno
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from deadly_work import Deadly
from small_study import batched, same_bits, small

import estimators as est
from estimators.study import Excitation, Noise, Plant, StorageError, WorkerError, fit_chunk, run, storage

ROOT = Path(__file__).parents[2]
QUIET = {"progress": False}


@pytest.fixture(scope="module")
def undisturbed():
    return est.study(small(), **QUIET)


def test_a_repetition_does_not_depend_on_the_chunk_or_on_how_many_there_are(undisturbed):
    for chunk in (1, 5):
        assert same_bits(est.study(small(), chunk=chunk, **QUIET), undisturbed)
    longer = est.study(small(repetitions=14), **QUIET)
    assert np.array_equal(longer["truth"].values[:12], undisturbed["truth"].values)
    assert len(np.unique(undisturbed["truth"].values[:, 0])) == 12


def test_a_study_goes_on_and_computes_nothing_twice(tmp_path, undisturbed, monkeypatch):
    out = tmp_path / "study"
    est.study(small(repetitions=5), out=out, chunk=2, **QUIET)
    before = {path: path.stat().st_mtime_ns for path in (out / "chunks").iterdir()}
    asked: list[int] = []
    compute = run.Repetitions.compute
    monkeypatch.setattr(run.Repetitions, "compute", lambda self, n: (asked.extend(n), compute(self, n))[1])
    assert same_bits(est.study(small(), out=out, chunk=3, **QUIET), undisturbed)
    assert asked == list(range(5, 12))
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # Fewer are a part of what is there.
    assert len(est.study(small(repetitions=3), out=out, **QUIET).index) == 3


def test_a_changed_study_is_refused_and_changes_nothing(tmp_path):
    out = tmp_path / "study"
    est.study(small(repetitions=2), out=out, **QUIET)
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    for change in ({"seed": 6}, {"noise": Noise(position=1e-4)}, {"plant": Plant(spread=0.2)}):
        with pytest.raises(StorageError, match=r"holds results of another study .* never mixed; name another folder"):
            est.study(small(repetitions=2, **change), out=out, **QUIET)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == kept


@pytest.mark.parametrize(
    ("spec", "kills"),
    [
        pytest.param(small(repetitions=150), 1, id="closed form"),
        pytest.param(small(repetitions=150), 3, id="closed form, three times", marks=pytest.mark.slow),
        pytest.param(batched(repetitions=150), 3, id="fits side by side", marks=pytest.mark.slow),
    ],
)
def test_kills_lose_nothing_and_leave_no_trace(tmp_path, spec, kills):
    """The process dies by SIGKILL, once or three times, at moments drawn by chance, while it computes."""
    whole = est.study(spec, **QUIET)
    out, file = tmp_path / "study", tmp_path / "study.toml"
    spec.save(file)
    code = f"""
import estimators as est, rtac_jax
rtac_jax.configure()
print("ready", flush=True)
est.study({str(file)!r}, out={str(out)!r}, chunk=2, progress=False)
"""
    random = np.random.default_rng(1)
    kept: dict[str, bytes] = {}
    for _ in range(kills):
        process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, env=_environment())
        assert process.stdout is not None
        process.stdout.readline()
        chunks = out / "chunks"
        while not chunks.is_dir() or len(list(chunks.glob("*.h5"))) <= len(kept):  # it has begun to keep its own
            assert process.poll() is None, "it ended by itself"
            time.sleep(0.005)
        time.sleep(float(random.uniform(0.0, 0.3)))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "it was done before it could be killed"
        process.stdout.close()
        now = {path.name: path.read_bytes() for path in chunks.glob("*.h5")}
        assert kept.items() <= now.items(), "what was finished stays as it was"
        kept = now
    assert kills <= len(kept) < 75
    again = est.study(spec, out=out, chunk=7, **QUIET)
    assert same_bits(again, whole)
    assert {name: (out / "chunks" / name).read_bytes() for name in kept} == kept
    assert not list(out.rglob("*.part"))


@pytest.mark.slow
def test_workers_end_with_the_process_that_asked_them(tmp_path):
    """Killed by SIGKILL it cannot tell them; they would wait for work for ever."""
    file, out = tmp_path / "study.toml", tmp_path / "study"
    small(repetitions=5000).save(file)
    code = f"""
import estimators as est, rtac_jax
from estimators.study import run
if __name__ == "__main__":
    rtac_jax.configure()
    with run._Pool(1) as pool:
        est.study({str(file)!r}, out={str(out)!r}, executor=pool, chunk=2, progress=False)
"""
    (tmp_path / "script.py").write_text(code)
    process = subprocess.Popen([sys.executable, str(tmp_path / "script.py")], env=_environment())
    while not list((out / "chunks").glob("*.h5")):
        assert process.poll() is None, "it ended by itself"
        time.sleep(0.05)
    workers = _children(process.pid)
    process.kill()
    process.wait()
    assert workers
    until = time.monotonic() + 30.0
    while any(map(_lives, workers)):
        assert time.monotonic() < until, "a worker lives on"
        time.sleep(0.1)


def _lives(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _children(parent: int) -> list[int]:
    """Processes that this one started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
    return found


@pytest.mark.slow
def test_memory_stays_as_it_is_however_many_repetitions_there_are():
    """Of one process after 100 repetitions and after 400 more, in chunks of one size; each records 200 kB."""
    code = f"""
import dataclasses, resource, sys
import estimators as est, rtac_jax
from estimators.study import Excitation, Plant
sys.path.insert(0, {str(ROOT / "tests")!r})
from small_study import small
rtac_jax.configure()
spec = small(excitation=(Excitation(duration=20.0, free=3, forced=0, rest=0),), plant=Plant(truth="model", spread=0.1))
for count, seed in ((100, 1), (400, 2)):
    est.study(dataclasses.replace(spec, repetitions=count, seed=seed), chunk=10, progress=False)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""
    said = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=_environment(), capture_output=True, check=True)
    few, many = map(float, said.stdout.split())
    assert many - few < 40.0  # MiB; half of what was recorded


def _environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


def test_a_full_disk_loses_nothing_that_was_finished(tmp_path, undisturbed, monkeypatch):
    out = tmp_path / "study"
    room = [4]  # chunks that the disk has room for
    fsync = os.fsync

    def full(file: int) -> None:
        if room[0] == 0:
            os.ftruncate(file, os.fstat(file).st_size // 2)  # what came out before there was no room
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        room[0] -= 1
        fsync(file)

    monkeypatch.setattr(storage.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        est.study(small(), out=out, chunk=2, **QUIET)
    assert sorted(path.name for path in (out / "chunks").iterdir()) == ["00000000.h5", "00000002.h5", "00000004.h5"]
    room[0] = 99
    assert same_bits(est.study(small(), out=out, **QUIET), undisturbed)


def test_a_damaged_chunk_and_a_second_process_are_refused(tmp_path):
    out = tmp_path / "study"
    est.study(small(repetitions=4), out=out, chunk=2, **QUIET)
    held = storage.Storage(out, small().digest, run.Repetitions(small()).layout)
    with held.locked(), pytest.raises(StorageError, match="another process is computing this study"):
        est.study(small(repetitions=4), out=out, **QUIET)
    path = out / "chunks" / "00000002.h5"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(StorageError, match=r"00000002.h5: is damaged .* remove it, and its repetitions are computed"):
        est.study(small(repetitions=4), out=out, **QUIET)


class OfThisProcess(Executor):
    """Runs at once; fails as it is told."""

    def __init__(self, *errors: Exception | None) -> None:
        self.errors = list(errors)

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        error = self.errors.pop(0) if self.errors else None
        if error is None:
            future.set_result(fn(*args, **kwargs))
        else:
            future.set_exception(error)
        return future


def test_any_executor_gives_the_same_bits_and_what_fails_there_is_tried_again(undisturbed):
    for errors in ((), (OSError("gone"), None, OSError("gone")), (OSError("gone"), OSError("gone"))):
        assert same_bits(est.study(small(), executor=OfThisProcess(*errors), chunk=5, **QUIET), undisturbed)
    with pytest.raises(WorkerError, match=r"repetitions 0 to 11 could not be computed in 3 attempts.*OSError: gone"):
        est.study(small(), executor=OfThisProcess(*[OSError("gone")] * 3), chunk=12, **QUIET)


def test_processes_agree_bit_by_bit_and_a_worker_that_dies_is_replaced(tmp_path, undisturbed, monkeypatch):
    deaths = tmp_path / "deaths"
    deaths.mkdir()
    (deaths / "1").touch()
    monkeypatch.setenv("RTAC_DEADLY", str(deaths))
    monkeypatch.setenv("PYTHONPATH", _environment()["PYTHONPATH"] + os.pathsep + str(ROOT / "tests"))
    work = Deadly(small())
    with run._Pool(1) as pool:  # one process: starting it is what takes the time
        index, arrays = run.repeated(work, "", executor=pool, out=None, chunk=4, progress=False)
    assert same_bits(est.StudyResults(small(), index, work.layout, arrays), undisturbed)
    assert not list(deaths.iterdir())


def test_workers_that_die_again_and_again_end_a_study(monkeypatch, tmp_path):
    pools = [OfThisProcess(*[BrokenProcessPool("dead")] * 6) for _ in range(4)]
    monkeypatch.setattr(run, "_renewed", lambda executor: contextlib.nullcontext(pools.pop()))
    alive_once = OfThisProcess(None, BrokenProcessPool("dead"))
    out = tmp_path / "study"
    with pytest.raises(
        WorkerError, match=r"worker processes died 3 times without finishing a chunk.* repetitions 4 to 7"
    ):
        est.study(small(), executor=alive_once, out=out, chunk=4, **QUIET)
    assert len(pools) == 2
    assert sorted(path.name for path in (out / "chunks").iterdir()) == ["00000000.h5", "00000008.h5"]


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match="executor: is 'threads'"):
        est.study(small(), executor="threads", **QUIET)
    with pytest.raises(ValueError, match="chunk: is 0"):
        est.study(small(), chunk=0, **QUIET)


def test_a_repetition_that_fails_is_counted_and_kept_with_its_reason(monkeypatch):
    function = fit_chunk._METHODS["least_squares"]
    seen: list[int] = []

    def sometimes(prepared, options, start):
        seen.append(1)
        if len(seen) in (2, 5):
            raise FloatingPointError("it ran\naway")
        return function(prepared, options, start)

    monkeypatch.setattr(fit_chunk, "_METHODS", {**fit_chunk._METHODS, "least_squares": sometimes})
    found = est.study(small(repetitions=8), **QUIET)
    assert list(found.index) == list(range(8))
    assert [n for n, reason in enumerate(found["reason"].values[:, 0]) if reason] == [1, 4]
    assert found.failures == {"least_squares": {"FloatingPointError: it ran away": 2}}
    assert float(found.failure_rate.sel(estimator="least_squares")) == 0.25
    assert found.summary()["count"].sel(estimator="least_squares", parameter="v/k").values == 6
    assert "least_squares failed in 2" in found.ending


def test_data_that_cannot_be_made_are_a_reason_too():
    spec = small(
        repetitions=6,
        plant=Plant(values={"eccentric_moment": [1e-3, 0.02]}),  # from 0.0108 on the arm would be heavier than the cart
    )
    reasons = est.study(spec, **QUIET)["reason"].values[:, 0]
    bad = [reason for reason in reasons if reason]
    assert 0 < len(bad) < 6
    assert all(reason.startswith("no truth: ValueError: Rig.eccentric_moment is too large") for reason in bad)


def test_the_excitation_and_what_is_hidden_take_turns():
    spec = small(
        repetitions=4,
        excitation=(
            Excitation(name="a", duration=0.4, free=1, forced=0, rest=0),
            dataclasses.replace(small().excitation[0], name="b"),
        ),
    )
    found = est.study(spec, **QUIET)
    assert list(found["excitation"].values) == ["a", "b", "a", "b"]
    assert list(found.select(excitation="b").index) == [1, 3]


def test_fewer_repetitions_of_a_finished_study_leave_what_is_there(tmp_path, undisturbed):
    est.study(small(), out=tmp_path, **QUIET)
    fewer = est.study(small(repetitions=5), out=tmp_path, **QUIET)
    assert len(fewer.index) == 5
    assert same_bits(est.StudyResults.load(tmp_path), undisturbed)
