"""The candidate set of a diagnosis, and the checks that each effect is declared well enough to be looked for."""

from collections.abc import Iterable, Sequence

import numpy as np

from estimators.diagnosis.wrong_constant import wrong_constants
from rtac_jax import RTAC
from rtac_jax.effect_contract import explained, require_working
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.parameters import Scales, declarations


def offered(model: RTAC, candidates: Sequence[type[Effect]] | None) -> list[type[Effect]]:
    """Return the candidate set: the whole catalogue and wrong constants, or these candidates.

    What the model has already is not in it, nor what stands only beside effects that the model lacks.

    Raises:
        ValueError: what is no class of effects, or one that is not declared well enough to be looked for.
    """
    classes = require_distinct(CATALOGUE.values() if candidates is None else candidates)
    found = [c for c in classes if c.id not in model and all(i in model for i in c.only_beside)]
    return found + wrong_constants(model) if candidates is None else found


def require_distinct(classes: Iterable[type[Effect]]) -> list[type[Effect]]:
    """Return the classes, after checking that each can be looked for and has an id of its own.

    Raises:
        ValueError: one cannot be looked for or does not keep its contract, or two have one id.
    """
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
    """Refuse what is no class of effects, or one that cannot be looked for.

    Raises:
        ValueError: names what is missing.
    """
    if not (isinstance(c, type) and issubclass(c, Effect)):
        raise ValueError(f"candidates: {c!r} is no class of effects; give the class, such as rtac.effects.CubicSpring.")
    for name in ("id", "equation", "source", "port"):
        if not isinstance(getattr(c, name, None), str):
            what = f"a {name} that is no text" if hasattr(c, name) else f"no {name}"
            raise ValueError(f"candidates: {c.__name__} has {what}; write {name}: ClassVar[str] = ... in the class.")
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
    """Return instances of plausible size on a rig of these scales.

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
