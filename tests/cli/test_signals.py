"""`rtac` as a process: interrupted at any moment, asked to stop, and with nobody reading what it says."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from rtac_jax.virtual_rig import Rig, record, standard_plans

# From where on the command answers signals; what the interpreter does before belongs to Python.
READY = "import rtac_entry; rtac_entry.answer_signals(); print('ready', flush=True); rtac_entry.main()"
INTERRUPTED = "rtac: interrupted; nothing that was not complete has been written."
STOPPED = "rtac: asked to stop (SIGTERM); nothing that was not complete has been written."


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "rig.h5"
    record(Rig(), standard_plans(seed=1, duration=2.0, free=1, forced=2, rest=1), seed=1).save(path)
    return path


def started(*arguments):
    process = subprocess.Popen(
        [sys.executable, "-c", READY, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(
    ("delay", "number"), [(0.0, 2), (0.6, 2), (0.3, 15), pytest.param(2.0, 15, marks=pytest.mark.slow)]
)
def test_a_signal_ends_it_at_once_with_one_sentence(file, tmp_path, delay, number):
    """Before and during the imports, which take a second or more."""
    process = started("fit", file, "--out", tmp_path / "out")
    time.sleep(delay)
    began = time.monotonic()
    process.send_signal(number)
    said, error = process.communicate(timeout=20)
    took = time.monotonic() - began
    assert process.returncode == 128 + number
    assert error.splitlines() == [INTERRUPTED if number == signal.SIGINT else STOPPED]
    assert said == ""
    assert took < 2
    assert not [path.name for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("delay", np.random.default_rng(0).uniform(0, 25, 5).round(1))
def test_a_signal_while_it_computes_leaves_the_old_results_whole(file, tmp_path, delay):
    """While it compiles, computes and writes; what was there before is there afterwards, or its successor is whole."""
    result = tmp_path / "result.json"
    result.write_text("{}\n")
    process = started("fit", file, "--json", result, "--out", tmp_path / "out")
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=2)
    if process.returncode == 0:  # it was faster
        return
    assert process.returncode == 130
    assert error.splitlines()[-1] == INTERRUPTED
    assert result.read_text().startswith("{")
    assert result.read_text().endswith("}\n")
    assert not [path.name for path in tmp_path.rglob("*.part")]


HOLDING = """
import ctypes, rtac_entry, sys
from pathlib import Path
rtac_entry.answer_signals()
from rtac_jax.measurement.atomic_write import replacing
with replacing(sys.argv[1]) as part:
    part.write_text("half")
    print("ready", flush=True)
    while True:
        ctypes.CDLL(None).sleep(30)  # foreign code, in which Python answers no signal
"""


def test_a_result_half_written_in_foreign_code_is_removed(tmp_path):
    old = tmp_path / "result.json"
    old.write_text("old")
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, old], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    assert len(list(tmp_path.iterdir())) == 2
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=2)
    assert (process.returncode, error) == (130, INTERRUPTED + "\n")
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    assert old.read_text() == "old"


def test_a_signal_that_the_caller_ignores_stays_ignored():
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import rtac_entry, os; rtac_entry.answer_signals(); "
        "os.kill(os.getpid(), signal.SIGINT); print('went on')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout) == (0, "went on\n")


def test_an_interrupt_after_all_is_said_changes_nothing():
    """While Python shuts down nobody answers, and it would be killed by the signal after its work was done."""
    code = (
        "import sys, time, types, os, signal; command = types.ModuleType('estimators.cli'); command.main = lambda: print('said'); "
        "sys.modules |= {'estimators': types.ModuleType('estimators'), 'estimators.cli': command}; "
        "import rtac_entry; rtac_entry.main(); os.kill(os.getpid(), signal.SIGINT); time.sleep(0.5); print('whole')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout, done.stderr) == (0, "said\nwhole\n", "")


WRITING = """
import rtac_entry, sys
rtac_entry.outlive_closed_pipes()
import typer
for line in range(20_000):
    typer.echo(f"line {line}")
open(sys.argv[1], "w").write("all of it")
"""


def test_a_closed_pipe_keeps_nothing_from_being_written(tmp_path):
    reading, writing = os.pipe()
    process = subprocess.Popen([sys.executable, "-c", WRITING, tmp_path / "x"], stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert os.read(reading, 6) == b"line 0"
    os.close(reading)
    _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (0, b"")
    assert (tmp_path / "x").read_text() == "all of it"


@pytest.mark.slow
def test_a_command_with_a_closed_pipe_ends_quietly(file):
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "rtac_entry", "info", file], stdout=writing, stderr=subprocess.PIPE, timeout=60
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, b"")


def test_whoever_hears_a_signal_second_says_nothing():
    """A handler and the thread that waits beside it may both hear one; the first is about to end the process."""
    script = "import os, rtac_entry\nrtac_entry.os._exit = lambda status: None\nfor _ in range(2): rtac_entry._end(2)"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=20, check=True)
    assert ended.stderr.splitlines() == [INTERRUPTED]
