"""What people at a terminal see of work that takes long, and what stands in a log."""

import io
import sys
import time

import jax.numpy as jnp
import pytest

from estimators.core import progress
from estimators.core.progress import Progress
from rtac_jax.programs import compiling, program


class Terminal(io.StringIO):
    """A terminal that remembers what was drawn on it."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Let seconds and minutes pass in a twentieth of a second."""
    monkeypatch.setattr(progress, "_REFRESH", 0.05)
    monkeypatch.setattr(progress, "_LINE", 0.05)
    monkeypatch.setattr(progress, "_clock", progress._Clock())


def until(holds) -> None:
    """Wait for another thread; fail after ten seconds."""
    end = time.monotonic() + 10
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_log_gets_whole_lines_with_what_is_done_and_left(capsys):
    with Progress("replicates", show=True, unit="draws", total=8) as shown:
        shown.count(2)
        said = []
        until(lambda: said.append(capsys.readouterr().err) or "2/8" in "".join(said))
    lines = "".join(said).splitlines()
    assert "\r" not in "".join(said)
    assert all(line.startswith("replicates: ") for line in lines)
    assert "25%" in lines[-1]
    assert "<" in lines[-1], "no time left is said"
    assert "draws/s" in lines[-1] or "s/ draws" in lines[-1]


@pytest.mark.slow
def test_work_of_many_short_parts_is_told_of_once_a_minute(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_LINE", 0.5)
    said = ""
    for _ in range(15):
        with Progress("part", show=True) as shown:
            time.sleep(0.1)
            shown.step()
        said += capsys.readouterr().err
    assert 2 <= len(said.splitlines()) <= 4
    time.sleep(1.2)  # more than a minute of nothing
    with Progress("later", show=True):
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_the_first_minute_of_a_process_is_silent(capsys, monkeypatch):
    """Also where the machine has just begun to count."""
    monkeypatch.setattr(progress, "_LINE", 1e9)
    with Progress("fit", show=True):
        time.sleep(0.2)
    assert capsys.readouterr().err == ""


def test_without_a_total_steps_and_what_was_noted_of_the_last_are_said():
    shown = Progress("fit", show=False)
    shown.step("cost 3")
    shown.at("fit, weighted")
    assert "cost" not in shown.line(), "the note is of what was done before"
    shown.step("cost 2")
    assert shown.line().startswith("fit, weighted: 2 steps [")
    assert "cost 2" in shown.line()


def test_a_bar_goes_on_while_code_compiles_and_says_what_compiles(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    names = ["_time_loop"]
    monkeypatch.setattr(progress, "compiling", lambda: tuple(names))
    with Progress("fit", show=True) as shown:
        until(lambda: "compiling time loop" in terminal.getvalue())
        names.clear()
        shown.step("cost 3")
        until(lambda: "cost 3" in terminal.getvalue())
    drawn = terminal.getvalue()
    assert ": :" not in drawn
    assert "\n" not in drawn, "a bar leaves nothing behind"


def test_nobody_is_told_where_that_is_not_wanted(capsys, monkeypatch):
    with Progress("fit", show=False) as quiet:
        quiet.step()
        quiet.say("a note")
        time.sleep(0.2)
    assert capsys.readouterr() == ("", "")


def test_an_error_ends_what_is_shown(capsys):
    with pytest.raises(FloatingPointError), Progress("fit", show=True) as shown:
        raise FloatingPointError
    assert shown._ended.is_set()


def test_a_program_is_named_while_it_is_traced_and_not_after():
    seen = []

    @program
    def _doubled(x):
        seen.append(compiling())
        return 2 * x

    assert float(_doubled(jnp.ones(()))) == 2.0
    assert all("_doubled" in names for names in seen)
    assert seen
    assert "_doubled" not in compiling()
