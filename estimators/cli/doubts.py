"""What is doubtful in a recording: said before an answer is computed from it, and where a fit fails."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rtac_jax.measurement import Recording

_SCALES = ("total_mass", "arm_inertia")


def doubtful(sentence: str) -> str:
    """Return a sentence of what is doubtful, marked as one."""
    return f"Doubtful: {sentence}"


def unmeasured(recording: "Recording") -> list[str]:
    """Return what is said of a cart without a sensor."""
    from rtac_jax.measurement import concerns

    return [said for said in concerns(recording) if "cart_position was not measured" in said]


def warn(doubts: Sequence[str]) -> None:
    """Say on the screen what is doubtful, before an answer is computed for minutes from it."""
    for sentence in doubts:
        typer.echo(f"rtac: {doubtful(sentence)}", err=True)


@contextmanager
def explaining(recording: "Recording", doubts: Sequence[str]) -> Iterator[None]:
    """Explain a fit that fails: what is doubtful in the recording comes first, as it is the likelier cause."""
    from estimators.core.results import DivergedError, NotIdentifiableError
    from rtac_jax.measurement import concerns

    try:
        yield
    except NotIdentifiableError as error:
        if more := unmeasured(recording):
            raise NotIdentifiableError(f"{error} {more[0]}") from error
        if doubts:
            raise NotIdentifiableError(_with_doubt(error, doubts)) from error
        raise
    except DivergedError as error:
        scale = [said for said in concerns(recording) if said.startswith("The scale is not fixed")]
        if scale:
            raise NotIdentifiableError(scale[0]) from error
        said = f"{error}{_guessed(recording)}"
        if doubts:
            raise DivergedError(_with_doubt(said, doubts)) from error
        raise DivergedError(said) from error


def _guessed(recording: "Recording") -> str:
    """Say which mass and inertia, by which all motion is scaled, a fit takes from the paper's rig as the recording tells none."""
    from rtac_jax import RTAC

    began = RTAC.from_rig(recording)
    guessed = [name for name in _SCALES if name in began.free and name not in recording.rig]
    if not guessed:
        return ""
    values = " and ".join(f"{name} = {float(began[name]):.3g} {began.parameters[name].unit}" for name in guessed)
    return (
        f" The fit began at the paper's {values}, as the recording tells none: of a rig of another size give rough values with"
        f" their deviations (rtac import --rig {guessed[0]}=... --rig {guessed[0]}_std=...)."
    )


def _with_doubt(error: Exception | str, doubts: Sequence[str]) -> str:
    """Return what is doubtful in the recording, and the error that came of it."""
    return f"{doubtful(doubts[0])} As it is, no fit comes of it: {error}"
