"""The one exception of result files."""


class ResultFileError(ValueError):
    """A file of results that cannot be read or written; the message says why and what helps."""
