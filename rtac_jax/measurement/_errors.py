"""The one error of this package."""

LONGEST = 2000
"""Characters of a message: a damaged file may hold a name as long as itself."""


class RecordingError(ValueError):
    """A recording, or the file that should hold one, that is not as it must be.

    The message is one sentence: the place (path inside the file, experiment, channel, sample), what was
    expected there, and what to do about it. What a file calls its parts stands in it with characters that end a line or steer a
    terminal written out.
    """

    def __init__(self, message: str) -> None:
        shown = printable(message)
        middle = LONGEST // 2
        super().__init__(shown if len(shown) <= LONGEST else f"{shown[:middle]} ... {shown[-middle:]}")


def printable(text: str) -> str:
    r"""Return text with every character that is not printable written out, as in "\n" or "\x1b"."""
    return text if text.isprintable() else "".join(c if c.isprintable() else _written_out(c) for c in text)


def _written_out(character: str) -> str:
    return character.encode("unicode_escape").decode()
