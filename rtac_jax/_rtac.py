"""The rig's model: a rigid body and the effects that act on it; `model + effect` is another model."""

import functools
import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rtac_jax._model_structure import declared_of, places_of, with_fixed
from rtac_jax._model_tables import overview_of, table_of
from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RIGID_STATES, RigidBody
from rtac_jax.arguments import checked_arguments
from rtac_jax.constants import require_constants
from rtac_jax.effects import (
    CATALOGUE,
    ArmViscous,
    CartCoulomb,
    CartViscous,
    Effect,
)
from rtac_jax.excited_parts import excited_parts
from rtac_jax.measurement import Recording
from rtac_jax.overview import Overview
from rtac_jax.parameters import Declaration, as_value
from rtac_jax.prior import Prior
from rtac_jax.storage import save

_PLACES = {name: place for place, name in enumerate(CATALOGUE)}

_PAPER = {
    "total_mass": 1.23,
    "arm_inertia": 9.5e-5,
    "eccentric_moment": 1.06e-3,
    "spring_stiffness": 132.6,
    "torque_constant": 8.04e-2,
}  # paper, Table 1
_FRICTION = {"cart": ("cart_viscous", "cart_coulomb"), "arm": ("arm_viscous",)}


class RTAC(eqx.Module):
    """A rigid body with effects.

    Attributes:
        body: equations (1) and (2).
        effects: what else acts, in the order in which actuator and sensor stages follow each other; `+` keeps the catalogue's.
        fixed: names of parameters that are not estimated, though they could be.
        per_experiment: names of parameters that each experiment has for itself.
        priors: of parameters that were measured by themselves and are known but for a standard deviation, by name. A fit
            estimates those that are not fixed, and counts how far they are from what was measured.

    Parameters are named `total_mass` for the body's and `cart_viscous.coefficient` for an effect's.
    """

    body: RigidBody
    effects: tuple[Effect, ...] = ()
    fixed: frozenset[str] = eqx.field(default=frozenset(), static=True)
    per_experiment: frozenset[str] = eqx.field(default=frozenset(), static=True)
    priors: dict[str, Prior] = eqx.field(default_factory=dict)

    def __check_init__(self) -> None:
        ids = [effect.id for effect in self.effects]
        twice = sorted({name for name in ids if ids.count(name) > 1})
        if twice:
            raise ValueError(f"the model already has {', '.join(twice)}; change its parameters with with_values.")
        self._require(self.fixed | self.per_experiment)

    def _require(self, names: Iterable[str]) -> None:
        """Refuse names that no parameter has."""
        unknown = sorted(set(names) - set(self.parameters))
        if unknown:
            raise ValueError(
                f"no parameter is called {', '.join(unknown)}; this model has {', '.join(self.parameters)}."
            )

    @classmethod
    def paper(cls) -> "RTAC":
        """Return the rig of the paper: Table 1, and v and d of section 4.2."""
        return cls(
            RigidBody(**_PAPER),
            (CartViscous(0.5543), CartCoulomb(0.024), ArmViscous(1.39e-4, 1.49e-4)),
        )

    @classmethod
    @checked_arguments
    def from_rig(cls, recording: Recording) -> "RTAC":
        """Return the paper's model for the rig of a recording: known constants fixed, and what nothing excites left out.

        A constant with a standard deviation (`NAME_std`) is not fixed but has a prior. The other parameters start at the
        paper's values; an estimator finds better ones from the data.

        Raises:
            ValueError: nothing moves in the recording, or it names a constant that the model does not have or that no rig
                has.
        """
        moves, unexcited = excited_parts(recording)
        fixed = (set(recording.rig) - set(recording.rig_std)) | unexcited
        known = {name: float(value) for name, value in recording.rig.items()}
        model = _paper_parts(moves, jnp.result_type(float))
        require_constants(model, known)
        priors = {name: Prior(known[name], std) for name, std in recording.rig_std.items() if name not in fixed}
        if priors:
            model = cls(model.body, model.effects, priors=priors)
        return model.with_values(known).fix(*(fixed & set(declared_of(model))))

    def __add__(self, effect: Effect | None) -> "RTAC":
        """Return the model with one effect more, at its place in the catalogue's order; one that is not in it comes last."""
        if effect is None:
            raise TypeError("nothing is to be added: `best` of a diagnosis that names no effect is None.")
        if not isinstance(effect, Effect):
            return NotImplemented
        if not isinstance(getattr(effect, "id", None), str):
            raise ValueError(
                f"{type(effect).__name__} has no id, by which its parameters are named; give the class one: id = ..."
            )
        places = [_PLACES.get(e.id, len(_PLACES)) for e in (*self.effects, effect)]
        at = max((i + 1 for i, place in enumerate(places[:-1]) if place <= places[-1]), default=0)
        effects = (*self.effects[:at], effect, *self.effects[at:])
        idle = {f"{effect.id}.{name}" for name in effect.idle}
        return type(self)(self.body, effects, self.fixed | idle, self.per_experiment, self.priors)

    def without(self, *ids: str) -> "RTAC":
        """Return the model less the effects with these ids.

        Raises:
            ValueError: the model has no such effect.
        """
        missing = sorted(set(ids) - {effect.id for effect in self.effects})
        if missing:
            raise ValueError(f"the model has no effect {', '.join(missing)}; it has {', '.join(self.ids)}.")
        kept = tuple(effect for effect in self.effects if effect.id not in ids)
        gone = {name for name in self.parameters if name.split(".")[0] in ids}
        return type(self)(self.body, kept, self.fixed - gone, self.per_experiment - gone, self.priors)

    @property
    def ids(self) -> tuple[str, ...]:
        """Return the ids of the effects."""
        return tuple(effect.id for effect in self.effects)

    def __contains__(self, effect_id: str) -> bool:
        return effect_id in self.ids

    # -- parameters --------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, Declaration]:
        """Return every parameter's declaration by name."""
        return dict(declared_of(self))

    @property
    def values(self) -> dict[str, Any]:
        """Return every parameter's value by name: a scalar, or one for each experiment."""
        # By places among the leaves, as in `with_values`.
        leaves, structure = jax.tree.flatten(self)
        names = tuple(declared_of(self))
        return {name: leaves[place] for name, place in zip(names, places_of(structure, names), strict=True)}

    @property
    def free(self) -> tuple[str, ...]:
        """Return the names of the parameters that a fit estimates."""
        return tuple(n for n, declared in declared_of(self).items() if n not in self.fixed and not declared.fixed)

    def __getitem__(self, name: str) -> Any:
        """Return the value of a parameter.

        Raises:
            KeyError: there is none of that name.
        """
        if name not in declared_of(self):
            raise KeyError(f"no parameter is called {name}; this model has {', '.join(self.parameters)}.")
        owner, _, field = name.rpartition(".")
        return getattr(self.effects[self.ids.index(owner)] if owner else self.body, field)

    def with_values(self, values: Mapping[str, Number | Sequence[Number]]) -> "RTAC":
        """Return the model with other values of some parameters; values may be traced, or one for each experiment."""
        if not values:
            return self
        # By places among the leaves: `eqx.tree_at` would look for them at every call, which studies make by the thousand.
        leaves, structure = jax.tree.flatten(self)
        for place, value in zip(places_of(structure, tuple(values)), values.values(), strict=True):
            leaves[place] = as_value(value)
        return jax.tree.unflatten(structure, leaves)

    def fix(self, *names: str) -> "RTAC":
        """Return the model with these parameters held at their values."""
        leaves, structure = jax.tree.flatten(self)
        return jax.tree.unflatten(with_fixed(structure, frozenset(names)), leaves)

    def release(self, *names: str) -> "RTAC":
        """Return the model with these parameters estimated."""
        self._require(names)
        return type(self)(self.body, self.effects, self.fixed - set(names), self.per_experiment, self.priors)

    def each_experiment(self, *names: str) -> "RTAC":
        """Return the model with a value of its own for each experiment in these parameters."""
        return type(self)(self.body, self.effects, self.fixed, self.per_experiment | set(names), self.priors)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model to a file (".h5") from which `rtac_jax.load` returns the same, bit for bit.

        Raises:
            ResultFileError: another ending.
            OSError: it cannot be written.
        """
        save(self, path)

    def overview(self) -> Overview:
        """Return every parameter with its value, and whether it is estimated."""
        return overview_of(self)

    def __repr__(self) -> str:
        what = ", ".join(self.ids) or "no effect"
        return f"RTAC: rigid body with {what}; {len(self.free)} of {len(self.parameters)} parameters are free"

    def _repr_html_(self) -> str:
        return self.overview().to_html()

    def __str__(self) -> str:
        return self.table()

    def table(self) -> str:
        """Return a table of parameters with symbol, value, unit and meaning, one a line."""
        return table_of(self)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Return the names of the parameters that a fit estimates around what was measured of them beforehand."""
        return tuple(name for name in self.priors if name in self.free and name not in self.per_experiment)

    @property
    def states(self) -> dict[str, str]:
        """Return the names and units of the states: the rigid body's four, then those of the effects."""
        found = dict(RIGID_STATES)
        for effect in self.effects:
            found |= {f"{effect.id}.{name}": unit for name, unit in effect.states.items()}
        return found


# A model holds arrays of the precision in which it was made.
@functools.lru_cache(maxsize=16)
def _paper_parts(moves: frozenset[str], precision: Hashable) -> "RTAC":
    """Return the paper's model with the friction of what moves."""
    with jax.ensure_compile_time_eval():  # or a model that is made within a function under `jit` would keep its tracers
        paper = RTAC.paper()
    ids = {name for part in moves for name in _FRICTION[part]}
    return paper.without(*(set(paper.ids) - ids))
