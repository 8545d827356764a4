"""Work whose workers die, for tests of what gives their chunks to others."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path

from estimators.study.layout import Arrays
from estimators.study.repetition import Repetitions


class Deadly(Repetitions):
    """Kills the process that computes it, as often as there are files to take away."""

    def compute(self, indices: Sequence[int]) -> Arrays:
        """Compute, or die."""
        for file in sorted(Path(os.environ["RTAC_DEADLY"]).iterdir()):
            file.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().compute(indices)
