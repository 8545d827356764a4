"""Which effects a diagnosis tries, and whether each is declared so that it can."""

from collections.abc import Iterable, Sequence

import numpy as np

from estimators._effect_contract import explained, require_working
from rtac_jax import RTAC
from rtac_jax._parameter import Scales, declarations
from rtac_jax.effects import CATALOGUE, Effect


def offered(model: RTAC, candidates: Sequence[type[Effect]] | None) -> list[type[Effect]]:
    """The whole catalogue or these candidates, without what the model has already.

    Raises:
        ValueError: what is no class of effects, or one that is not declared well enough to be looked for.
    """
    classes = require_distinct(CATALOGUE.values() if candidates is None else candidates)
    return [c for c in classes if c.id not in model]


def require_distinct(classes: Iterable[type[Effect]]) -> list[type[Effect]]:
    """The same classes; raises `ValueError` if one cannot be looked for or does not keep its contract, or two have one id."""
    found = list(classes)
    for c in found:
        require_declared(c)
        if CATALOGUE.get(c.id) is not c:
            require_working(c)
    ids = [c.id for c in found]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise ValueError(f"candidates: {', '.join(twice)} occurs twice; give each effect an id of its own.")
    return found


def require_declared(c: object) -> None:
    """Raises `ValueError` for what is no class of effects, or one that cannot be looked for."""
    if not (isinstance(c, type) and issubclass(c, Effect)):
        raise ValueError(f"candidates: {c!r} is no class of effects; give the class, such as rtac.effects.CubicSpring.")
    for name in ("id", "equation", "source", "port"):
        if not isinstance(getattr(c, name, None), str):
            raise ValueError(f"candidates: {c.__name__} has no {name}; write {name}: ClassVar[str] = ... in the class.")
    if not c.id.isidentifier():
        raise ValueError(
            f"candidates: {c.__name__} has the id {c.id!r}; use letters, digits and underscores, a letter first."
        )
    if not c.amplitudes():
        raise ValueError(
            f"candidates: no parameter of {c.id} has a null value, so it can never be absent; declare null=0.0 for its size."
        )
    for name in c.amplitudes():
        null = declarations(c)[name].null
        if null != 0.0:
            raise ValueError(
                f"candidates: {c.id}.{name} has the null value {null}; write it as a deviation that is 0 where it is absent."
            )


def plausible(c: type[Effect], scales: Scales) -> tuple[Effect, ...]:
    """Instances of plausible size on a rig of these scales.

    Raises:
        ValueError: a size of an effect outside the catalogue that is no size.
    """
    if CATALOGUE.get(c.id) is c:
        return c.candidates(scales)
    found = explained(c, "plausible", lambda: c.candidates(scales))
    for instance in found:
        for name in c.amplitudes():
            size = float(np.asarray(getattr(instance, name)))
            if not (np.isfinite(size) and size != 0.0):
                raise ValueError(
                    f"candidates: the plausible size of {c.id}.{name} is {size:g}; give one that is finite and not 0."
                )
    return found
