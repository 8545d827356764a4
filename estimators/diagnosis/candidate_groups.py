"""Groups of candidates that are simulated together, each with a model that has them at null."""

from collections.abc import Sequence
from typing import NamedTuple

from estimators.diagnosis.setting import Setting, model_with
from estimators.diagnosis.shared_structure import is_short, is_simple, probed_model
from rtac_jax import RTAC
from rtac_jax.effects import Input


class CandidateGroup(NamedTuple):
    """Candidates, by id, and the model with all of them at null."""

    ids: list[str]
    model: RTAC


def candidate_groups(setting: Setting, added: Sequence[str]) -> list[CandidateGroup]:
    """Return the candidates that were not added, in groups of what is as dear to simulate.

    Every probe of a group takes the effort of all its effects. Most candidates are simple and cost a sixth of those with states,
    thresholds or bristles; those on the inputs ask for new polynomials of the whole record at every point, which cost as much as
    all others together. Of few samples the models hold more than the group, so that an effect that is added changes none of them.
    """
    inputs = [i for i, effect in setting.absent.items() if isinstance(effect, Input)]
    simple = [i for i, effect in setting.absent.items() if is_simple(effect)]
    others = [i for i in setting.absent if i not in inputs and i not in simple]
    if not is_short(setting):
        groups = [CandidateGroup(ids, _beside(setting, (*added, *ids))) for ids in (others, simple, inputs)]
    else:
        apart, beyond = probed_model(setting, added), _beside(setting, (*added, *others, *simple))
        known = [CandidateGroup([*others, *simple], beyond)]
        if apart is not None:
            known = [CandidateGroup(others, beyond), CandidateGroup(simple, apart)]
        groups = [*known, CandidateGroup(inputs, _beside(setting, (*added, *simple, *inputs)))]
    left = [group._replace(ids=[i for i in group.ids if i not in added]) for group in groups]
    return [group for group in left if group.ids]


def model_alone(setting: Setting, added: Sequence[str]) -> RTAC:
    """Return the model with what was added, or the one of its structure that others share."""
    return _beside(setting, added) if (common := probed_model(setting, added)) is None else common


def model_beside(setting: Setting, added: Sequence[str], candidate: str) -> RTAC:
    """Return the model with what was added, and one candidate at null."""
    return _beside(setting, (*added, candidate))


def _beside(setting: Setting, effects: Sequence[str]) -> RTAC:
    return model_with(setting, [effect for i, effect in setting.absent.items() if i in effects])
