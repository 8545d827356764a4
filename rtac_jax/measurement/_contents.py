"""The contents of a recording, for readers, writers and descriptions, which the class itself imports."""

from collections.abc import Mapping
from typing import Protocol

from ._experiment import Experiment


class Contents(Protocol):
    """Experiments on one rig, and what is known of it; `Recording` says what each of these is."""

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """Return the experiments, in order."""
        ...

    @property
    def rig(self) -> Mapping[str, float]:
        """Return the constants known beforehand."""
        ...

    @property
    def rig_std(self) -> Mapping[str, float]:
        """Return standard deviations of constants."""
        ...

    @property
    def rig_name(self) -> str:
        """Return the name of the rig."""
        ...

    @property
    def comment(self) -> str:
        """Return the comment."""
        ...

    @property
    def rig_attributes(self) -> dict[str, float]:
        """Return the constants and, as `NAME_std`, their standard deviations, as a file keeps them."""
        ...
