"""Compute what is missing of a study, chunk by chunk, on any executor."""

import multiprocessing
import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax

from estimators.core.progress import Progress
from estimators.core.threads import one_thread
from estimators.study.layout import Arrays
from estimators.study.repetition import Repetitions
from estimators.study.results import StudyResults
from estimators.study.spec import StudySpec
from estimators.study.storage import Storage, description_in
from estimators.study.work import Work
from rtac_jax import configure, require_configured

ATTEMPTS = 3
"""How often a chunk is tried, and how often workers may die one after the other without a chunk finished in between."""


class WorkerError(RuntimeError):
    """Workers die again and again; finished chunks are kept."""


def study(
    spec: StudySpec | str | os.PathLike[str],
    *,
    executor: Executor | str | None = None,
    out: str | os.PathLike[str] | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> StudyResults:
    """Run a Monte Carlo study, or go on with it where it was ended.

    Results are the same bits whatever the executor and the size of chunks. Each chunk that is finished is a file in `out`, written
    aside and renamed, so that nothing finished is lost when the process is killed, and nothing is computed twice. A study may be
    made longer later by more `repetitions`; any other change of what is computed is refused there.

    Args:
        spec: the study, or the TOML file that describes it.
        executor: where chunks are computed: None for this process, "processes" for one process for each core, or any
            `concurrent.futures.Executor` whose workers have this package, such as dask's `Client.get_executor()`.
            Processes of a pool must be spawned, as JAX does not survive a fork.
        out: folder of the results; None keeps them in memory only.
        chunk: repetitions that are computed and written together; by default as many as suit the methods.
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        SpecError: the study is not described as it must be.
        StorageError: `out` holds another study, or another process computes this one.
        WorkerError: workers die again and again.
        OSError: `out` cannot be written to, such as on a full disk; what was finished is kept.
        RuntimeError: JAX was not configured for double precision.
    """
    described = spec if isinstance(spec, StudySpec) else StudySpec.load(spec)
    require_configured()
    work = Repetitions(described)
    text = _description(described, out)
    indices, arrays = repeated(work, text, executor=executor, out=out, chunk=chunk, progress=progress)
    return StudyResults(described, indices, work.layout, arrays)


def _description(spec: StudySpec, out: str | os.PathLike[str] | None) -> str:
    """Return what is kept beside the results: of the study in the folder, where it is the same and longer."""
    if out is not None:
        try:
            text = description_in(out)
            there = StudySpec.from_toml(text)
        except (OSError, ValueError):
            return spec.to_toml()
        if there.digest == spec.digest and there.repetitions > spec.repetitions:
            return text
    return spec.to_toml()


def repeated(
    work: Work,
    description: str,
    *,
    executor: Executor | str | None,
    out: str | os.PathLike[str] | None,
    chunk: int | None,
    progress: bool,
) -> tuple[Any, Arrays]:
    """Compute what is missing of some work and read all of it; see `study`.

    Raises:
        ValueError: `chunk` is below 1, or `executor` is an unknown name.
    """
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk: is {chunk}; give at least 1.")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) if out is None else Path(out)
        storage = Storage(folder, work.digest, work.layout)
        storage.begin(description)
        stack.enter_context(storage.locked())
        done = storage.done()
        gone = set(done)
        missing = [index for index in range(work.count) if index not in gone]
        size = chunk or work.per_chunk
        parts = [missing[first : first + size] for first in range(0, len(missing), size)]
        counted = work.count - len(missing)
        with Progress(work.name, show=progress, unit="repetitions", total=work.count, done=counted) as shown:
            for indices, arrays in _computed(work, parts, executor):
                storage.keep(indices, arrays)
                shown.count(len(indices))
        return storage.read(below=work.count)


def _computed(
    work: Work, parts: Sequence[Sequence[int]], executor: Executor | str | None
) -> Iterator[tuple[Sequence[int], Arrays]]:
    """Yield chunks as they are finished, in any order."""
    if executor is None:
        for part in parts:
            yield part, work.compute(part)
        return
    if isinstance(executor, str):
        if executor != "processes":
            raise ValueError(f"executor: is {executor!r}; use 'processes', an Executor, or None.")
        with _Pool() as pool:
            yield from _distributed(work, parts, pool)
        return
    yield from _distributed(work, parts, executor)


class _Setting(NamedTuple):
    """The setting on which numbers depend besides the work: workers compile as this process does."""

    flags: str
    cache: str | None

    @classmethod
    def here(cls) -> "_Setting":
        return cls(os.environ.get("XLA_FLAGS", ""), jax.config.values["jax_compilation_cache_dir"])


def _in_worker(work: Work, indices: Sequence[int], setting: _Setting, attempt: int) -> Arrays:
    """Compute one chunk, in another process.

    Args:
        work: what a repetition is.
        indices: numbers of the repetitions.
        setting: of the process that asks.
        attempt: makes one attempt another call than the last, as dask answers the same call with what it knows already.
    """
    del attempt
    if os.environ.get("XLA_FLAGS", "") != setting.flags and not jax.config.read("jax_enable_x64"):
        os.environ["XLA_FLAGS"] = setting.flags  # before JAX starts
    if not jax.config.read("jax_enable_x64"):
        configure(fast=False, cache=setting.cache)
    with one_thread():
        return work.compute(indices)


def _distributed(
    work: Work, parts: Sequence[Sequence[int]], executor: Executor
) -> Iterator[tuple[Sequence[int], Arrays]]:
    """Chunks from the workers of an executor; those of a worker that dies are given to another."""
    setting = _Setting.here()
    attempts: dict[int, int] = dict.fromkeys(range(len(parts)), 0)
    waiting = list(attempts)
    running: dict[Future[Arrays], int] = {}
    deaths = 0
    with ExitStack() as stack:
        try:
            while waiting or running:
                try:
                    while waiting:
                        number = waiting[0]
                        attempt = attempts[number] + deaths
                        running[executor.submit(_in_worker, work, parts[number], setting, attempt)] = number
                        waiting.pop(0)
                except BrokenExecutor as error:
                    if not running:
                        executor, deaths = stack.enter_context(_renewed(executor)), deaths + 1
                        _require_alive(deaths, parts[waiting[0]], error)
                        continue
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                broken: BaseException | None = None
                for future in finished:
                    number = running.pop(future)
                    error = future.exception()
                    if error is None:
                        deaths = 0
                        yield parts[number], future.result()
                        continue
                    waiting.append(number)
                    if isinstance(error, BrokenExecutor):
                        broken = error
                        continue
                    attempts[number] += 1
                    if attempts[number] >= ATTEMPTS:
                        first, last = parts[number][0], parts[number][-1]
                        raise WorkerError(
                            f"repetitions {first} to {last} could not be computed in {ATTEMPTS} attempts, the last of which ended "
                            f"with {type(error).__name__}: {error}; what is finished is kept."
                        ) from error
                if broken is not None:
                    waiting += running.values()  # the whole pool is gone
                    running.clear()
                    waiting.sort()
                    deaths += 1
                    _require_alive(deaths, parts[waiting[0]], broken)
                    executor = stack.enter_context(_renewed(executor))
        finally:
            for future in running:
                future.cancel()


def _require_alive(deaths: int, part: Sequence[int], error: BaseException) -> None:
    if deaths >= ATTEMPTS:
        raise WorkerError(
            f"worker processes died {deaths} times without finishing a chunk, the next of which is repetitions {part[0]} to "
            f"{part[-1]}; there may be too little memory, so take fewer workers or smaller chunks. What is finished is kept."
        ) from error


class _Pool(ProcessPoolExecutor):
    """Spawned processes, one for each core by default, that end with the one that asked them."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this worker as soon as the process that started it has ended.

    One that is killed cannot tell its workers, and they would wait for work, and hold their memory, for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a parent"

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _renewed(executor: Executor) -> Executor:
    """Return a pool as large as the one that broke, which cannot be used again."""
    return _Pool(getattr(executor, "_max_workers", None))  # there is no public question for its size
