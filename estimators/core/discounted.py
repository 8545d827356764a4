"""The samples that a robust fit discounts."""

import dataclasses

_SHOWN = 3


@dataclasses.dataclass(frozen=True)
class Discounted:
    """Samples of one channel of one experiment that hardly count in a robust fit, because they lie too far off for noise.

    Attributes:
        experiment, channel: names.
        samples: their numbers, from zero.
        sample_time: [s].
    """

    experiment: str
    channel: str
    samples: tuple[int, ...]
    sample_time: float

    @property
    def instants(self) -> tuple[float, ...]:
        """Times [s]."""
        return tuple(n * self.sample_time for n in self.samples)

    def __str__(self) -> str:
        shown = ", ".join(f"{t:.4g}" for t in self.instants[:_SHOWN])
        more = ", ..." if len(self.samples) > _SHOWN else ""
        many = f"{len(self.samples)} samples" if len(self.samples) > 1 else "1 sample"
        return f"{self.experiment}, {self.channel}: {many} discounted, at {shown}{more} s"
