"""The one error of this package."""


class RecordingError(ValueError):
    """A recording, or the file that should hold one, that is not as it must be.

    The message is one sentence: the place (path inside the file, experiment, channel, sample), what was
    expected there, and what to do about it.
    """
