"""The structure of a model: where its parameters stand among its leaves, found once for all models of one structure.

No methods: equinox makes an object of its own whenever it is asked for a method, which takes longer than what they do.
"""

import functools
import types
from collections.abc import Mapping
from typing import Any

import jax

from rtac_jax.parameters import Declaration, declarations


def declared_of(model: Any) -> Mapping[str, Declaration]:
    """Return every parameter's declaration by name."""
    return _declared_by(type(model.body), tuple((effect.id, type(effect)) for effect in model.effects))


@functools.lru_cache(maxsize=1024)
def _declared_by(body: type, effects: tuple[tuple[str, type], ...]) -> Mapping[str, Declaration]:
    found = dict(declarations(body))
    for name, effect in effects:
        found |= {f"{name}.{field}": declared for field, declared in declarations(effect).items()}
    return types.MappingProxyType(found)


@functools.lru_cache(maxsize=256)
def with_fixed(structure: Any, names: frozenset[str]) -> Any:
    """Return the structure of a model with these parameters fixed besides; to check a model of it once is enough."""
    model = jax.tree.unflatten(structure, [0.0] * structure.num_leaves)
    fixed = type(model)(model.body, model.effects, model.fixed | names, model.per_experiment, model.priors)
    return jax.tree.structure(fixed)


@functools.lru_cache(maxsize=256)
def places_of(structure: Any, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return where these parameters stand among the leaves of a model of this structure."""
    model = jax.tree.unflatten(structure, range(structure.num_leaves))
    return tuple(model[name] for name in names)
