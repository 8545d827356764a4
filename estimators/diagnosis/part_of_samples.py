"""A part of the samples of a long recording, which shows what a fit misses by more than the noise as well as all of them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from estimators.core.data import Data, motion_of, moving, origins, pieces
from estimators.core.fit import Fit
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.inference.shaken_simulation import unfollowed
from rtac_jax.measurement import Experiment, Recording

# Samples of all experiments together. What takes a hundredth off the rms error (`DiagnosisPolicy.consequence`) scores 320 in them,
# sixteen times what an alarm asks for; seeded studies of the diagnosis have 15,000.
_ENOUGH = 16_000
_LEAST = 1_000  # of each of many experiments
_LIVELY = 0.5  # rms of a beginning over that of the whole, from which on it shows as much


def part_of(recording: Recording) -> Recording:
    """Return the beginning of every experiment of a long recording, if they show as much motion, or else the recording.

    What dominates an error shows in a part of many samples as well, and every refit takes as long as there are samples.
    """
    whole = moving(recording)
    several = pieces(whole)
    if sum(e.samples for e in several) < 2 * _ENOUGH:
        return recording
    samples = max(_ENOUGH // len(whole), _LEAST)
    origin = origins(whole)
    found = [_beginning([e for e in several if origin[e.name] == one.name], samples) for one in whole]
    part = [e for beginnings in found for e in beginnings]
    if np.any(motion_of(Data.of(part)) < _LIVELY * motion_of(Data.of(several))):
        return recording
    rest = [e for e in recording.experiments if e.kind == "rest"]
    return dataclasses.replace(recording, experiments=(*part, *rest))


def enough_of(fit: Fit, recording: Recording, policy: DiagnosisPolicy) -> Recording:
    """Return the part of a recording that a diagnosis looks at first: all of it where the fit is at the noise.

    What is small beside what is found in a part is for the diagnosis of the model with it, which sees all.

    Args:
        fit: that is diagnosed.
        recording: that it was fitted to.
        policy: the thresholds.
    """
    part = part_of(recording)
    if part is recording or unfollowed(fit, Data.of(pieces(moving(recording))), policy.simulation) == 0.0:
        return recording
    return part


def suffices(told: Diagnosis, *, gross: bool) -> bool:
    """Return whether a diagnosis of a part need not be asked of all samples.

    Args:
        told: the diagnosis of the part.
        gross: whether the fit follows nothing. Then any effect that is added brings it nearer; else the part has to explain
            everything by effects that it tells from all others.
    """
    plain = told.verdict == "missing" and not any(c.confusable_with for c in told.effects)
    return bool(told.additions) and (gross or plain)


def _beginning(several: Sequence[Experiment], samples: int) -> list[Experiment]:
    """Return the beginning of an experiment, or those of its pieces, from first to last, that have about as many samples."""
    if len(several) > 1:
        count = min(max(samples // several[0].samples, 1), len(several))
        return [several[place] for place in np.linspace(0, len(several) - 1, count).astype(int)]
    return [several[0].cut(0, min(samples, several[0].samples), several[0].name)]
