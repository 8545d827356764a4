"""Outcomes of numerical methods: a sentence that says what happened and what to try."""

import equinox as eqx
import numpy as np


class RESULTS(eqx.Enumeration):
    """The outcomes of fits and diagnoses; `str` of a member is its sentence."""

    successful = "The fit converged."
    steps_exhausted = (
        "The fit did not converge in the steps allowed; allow more (steps of est.output_error), or go on from where it ended "
        "(--save and --model of rtac)."
    )
    crept = (
        "The fit was stopped where it only crept on, far from the data; ask est.diagnose what the model lacks, or begin elsewhere "
        "(starts)."
    )
    pulled_off_bound = (
        "The fit did not converge: an estimate lies on its bound, and the data pull it inwards; begin with a plausible value "
        "of it (model.with_values), or fix it (model.fix, or --fix of rtac)."
    )
    stuck = (
        "The fit came to rest where its slopes still promise a better place; begin elsewhere, or fit this recording alone "
        "(est.output_error)."
    )
    starts_disagree = (
        "The fit converged, but no second start reached the same place; it may be a local minimum, "
        "so compare the model with the data before trusting it."
    )
    diverged = "The model diverges at the start values; give start values nearer to the rig, or check the units."
    undetermined = (
        "The data leave combinations of parameters free where the fit ended; fix a parameter (model.fix, or --fix of rtac), or add "
        "an experiment."
    )


STOPPED = (RESULTS.steps_exhausted, RESULTS.crept)
"""Results of fits that were stopped before they converged."""


class NotIdentifiableError(ValueError):
    """Data that leave combinations of parameters free; the message names them and what would fix them.

    Attributes:
        unseen: names of effects' parameters that show nowhere, where nothing else is free, and not all are.
    """

    def __init__(self, message: str, unseen: tuple[str, ...] = ()) -> None:
        """Say what is free."""
        super().__init__(message)
        self.unseen = unseen


class TooLargeError(ValueError):
    """A recording that does not fit into memory; the message says how much it takes, and how to make it smaller."""


class DivergedError(ArithmeticError):
    """A model that left all bounds; the message says where and what to try."""


FAILURES = (NotIdentifiableError, DivergedError, FloatingPointError, np.linalg.LinAlgError)
"""What a fit that comes to nothing ends with; the last where a model follows so little that a matrix is singular."""
