"""Something that is repeated: what a study, or a bootstrap, computes in chunks."""

import abc
from collections.abc import Sequence

from estimators.study.layout import Arrays, Layout


class Work(abc.ABC):
    """Repetitions that are numbered from zero; it is pickled to workers, which compute any of them."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Return what a bar of progress shows."""

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Return how many repetitions there are."""

    @property
    @abc.abstractmethod
    def digest(self) -> str:
        """Hash of all that the numbers of a repetition depend on."""

    @property
    @abc.abstractmethod
    def per_chunk(self) -> int:
        """Return how many one chunk has, if nobody says otherwise."""

    @property
    @abc.abstractmethod
    def layout(self) -> Layout:
        """Return what a repetition keeps."""

    @abc.abstractmethod
    def compute(self, indices: Sequence[int]) -> Arrays:
        """Compute the repetitions with these numbers; the bits of each depend on the work and its number alone."""
