"""The number of repetitions of a chunk, if nobody says otherwise."""

import numpy as np

from estimators.study.batched_fits import suits
from estimators.study.spec import StudySpec

_PER_CHUNK = {"diagnosis": 1, "envelope": 2}  # these take minutes and seconds; a kill loses one chunk
_MOST_PER_CHUNK = 25
# Output error that begins at the truth is fitted side by side, and the last fits of a chunk leave places empty: chunks are as
# large as memory allows, with so many samples of all experiments, but small enough that little is lost with one.
_SAMPLES_TOGETHER, _MOST_TOGETHER = 2_000_000, 250


def per_chunk(spec: StudySpec) -> int:
    """Return how many repetitions are computed and written together; the numbers do not depend on it."""
    samples = max(one.moving * one.duration / one.sample_time for one in spec.excitation)
    together = int(np.clip(_SAMPLES_TOGETHER / samples, _MOST_PER_CHUNK, _MOST_TOGETHER))
    return min(
        together if suits(one, spec.model.start) else _PER_CHUNK.get(one.method, _MOST_PER_CHUNK)
        for one in spec.estimate
    )
