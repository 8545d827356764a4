"""What counts as a refusal in the fuzzing suite: what the command line says in one sentence, and nothing else."""

import pytest
from fuzz import REFUSALS, outcome
from typer import Exit

from estimators.cli.refusals import answering
from rtac_jax.measurement import RecordingError


@pytest.mark.parametrize("kind", [*REFUSALS, RecordingError, FloatingPointError, FileNotFoundError])
def test_the_command_line_says_every_refusal_in_a_sentence(kind, capsys):
    with pytest.raises(Exit) as caught, answering():
        raise kind("this is wrong; mend it.")
    assert caught.value.exit_code in (1, 2)
    assert capsys.readouterr().err == "rtac: this is wrong; mend it.\n"


@pytest.mark.parametrize("kind", [TypeError, KeyError, IndexError, AttributeError, RuntimeError, RuntimeWarning])
def test_what_is_no_refusal_fails_a_trial(kind):
    def fault():
        raise kind("unexpected")

    with pytest.raises(kind):
        outcome(fault)


def test_a_refusal_of_another_library_fails_a_trial():
    with pytest.raises(AssertionError, match="could not convert"):
        outcome(float, "text")
