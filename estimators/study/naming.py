"""The outcome of a diagnosis beside what was hidden."""

import itertools

from rtac_jax.effects import CATALOGUE
from rtac_jax.effects.one_sided_spring import GROSS

NOTHING = "nothing"


def outcome(hidden: str, verdict: str, named: str) -> str:
    """Return what a verdict was worth: every effect that was hidden has to be in a group of its own.

    Args:
        hidden: effects joined by " + ", or "nothing".
        verdict: of the diagnosis.
        named: groups joined by " + ", the effects of one by "|".
    """
    if verdict not in ("missing", "ambiguous"):
        return "right" if verdict == "adequate" and hidden == NOTHING else verdict
    truth = hidden.split(" + ")
    groups = [set(group.split("|")) for group in named.split(" + ")] if named else []
    fewer = min(len(groups), len(truth))
    matched = max(
        sum(one in group for one, group in zip(some, order, strict=True))
        for some in itertools.permutations(truth, fewer)
        for order in itertools.combinations(groups, fewer)
    )
    if matched < fewer or not set(truth) <= {*CATALOGUE, *GROSS}:
        return "wrong"
    if len(groups) > len(truth):
        return "right and more"
    if len(groups) < len(truth):
        return "a part"
    return "right" if all(len(group) == 1 for group in groups) else "in the group"
