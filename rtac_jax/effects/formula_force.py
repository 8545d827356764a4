"""A force in closed form that was read off a curve: a sum of few terms of one variable, each with a coefficient and a unit."""

import functools
import hashlib
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.effects.spline_force import PORT_UNITS, PORTS, VARIABLE_UNITS, VARIABLES, on_curve
from rtac_jax.parameters import parameter

_SYMBOLS = {"cart_position": "q", "cart_velocity": "q'", "arm_angle": "θ", "arm_velocity": "θ'", "current": "i"}
_SHAPED = ("saturation", "peak", "sine", "cosine")
_SCALED = ("saturation", "peak")  # by a scale; the others by a wave number


class Term(NamedTuple):
    """One term of a formula.

    Attributes:
        kind: "power" for x^number, "odd" for x |x|^(number - 1), "sign", "saturation" for tanh(x / scale), "peak" for
            x / (1 + (x / scale)^2), which is largest at the scale and falls beyond, as an eddy-current brake does (Smythe, Trans.
            AIEE 61 (1942)), "sine" or "cosine".
        number: exponent; of a sine or cosine the wave number where it is a whole number of periods in a turn, or 0 where
            the wave number is a parameter.
    """

    kind: str
    number: int = 0

    @property
    def shaped(self) -> bool:
        """Return whether a parameter of its own shapes the term."""
        return self.kind in _SHAPED and self.number == 0

    def value(self, x: Number, shape: Number, slow: Number, xp: ModuleType = np) -> Any:
        """Return the term at x with a coefficient of one.

        Args:
            x: the variable, SI units.
            shape: scale of a saturation or peak [unit of x], or wave number [1/unit of x].
            slow: below which a sign fades [unit of x].
            xp: `numpy` or `jax.numpy`.
        """
        if self.kind == "power":
            return x**self.number if self.number else xp.ones_like(x)
        if self.kind == "odd":
            return x * xp.abs(x) ** (self.number - 1)
        if self.kind == "sign":
            return x / xp.sqrt(x * x + slow * slow)
        if self.kind == "saturation":
            return xp.tanh(x / shape)
        if self.kind == "peak":
            return x / (1.0 + (x / shape) ** 2)
        return (xp.sin if self.kind == "sine" else xp.cos)((self.number or shape) * x)

    def text(self, symbol: str, place: int) -> str:
        """Return the term in words of the field, its shape named by its place in the formula."""
        if self.kind == "power":
            return "" if not self.number else symbol if self.number == 1 else f"{symbol}^{self.number}"
        if self.kind == "odd":
            return f"{symbol} |{symbol}|" if self.number == 2 else f"{symbol} |{symbol}|^{self.number - 1}"
        if self.kind == "sign":
            return f"sign({symbol})"
        if self.kind == "saturation":
            return f"tanh({symbol} / s_{place})"
        if self.kind == "peak":
            return f"{symbol} / (1 + ({symbol} / s_{place})^2)"
        inner = symbol if self.number == 1 else f"{self.number} {symbol}" if self.number else f"k_{place} {symbol}"
        return f"{'sin' if self.kind == 'sine' else 'cos'}({inner})"


class FormulaForce(Force):
    """A force on the cart or the arm that is a sum of terms of one variable; `formula_class` makes its subclasses."""

    id: ClassVar[str] = "formula"
    equation: ClassVar[str] = "sum of c_i f_i(x)"
    source: ClassVar[str] = "read off the curve of a diagnosis"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "source"
    variable: ClassVar[str] = "cart_position"
    terms: ClassVar[tuple[Term, ...]] = ()
    slow: ClassVar[float] = 1e-4
    made_by: ClassVar[tuple[Any, ...]] = ()

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        """Return force on the cart [N] and torque on the arm [N m]."""
        del own
        chosen = jnp.eye(len(VARIABLES))[VARIABLES.index(self.variable)]
        x, rubs = on_curve(motion, chosen, 0.0, 1.0, self.slow)
        total: Any = 0.0
        for place, term in enumerate(self.terms, 1):
            shape = getattr(self, f"shape_{place}") if term.shaped else 1.0
            total = total + getattr(self, f"coefficient_{place}") * term.value(x, shape, self.slow, jnp)
        on = [float(self.port == name) for name in PORTS]
        return on[0] * total * rubs, on[1] * total * rubs


def _named(port: str, variable: str, terms: tuple[Term, ...]) -> str:
    """Return the id of a formula, in words: the law's variable, where it acts if that is elsewhere, and its terms."""
    base, rubs = variable.split(",")[0], "," in variable
    where = "" if base.startswith(port) or (port == "arm" and base == "current") else f"{port}_"
    kinds = "_".join(f"{term.kind}{term.number or ''}" for term in terms)
    return f"{where}law_of_{base}{'_in_friction' if rubs else ''}_{kinds}"


@functools.cache
def formula_class(port: str, variable: str, terms: tuple[Term, ...], slow: float) -> type[FormulaForce]:
    """Return the effect whose force is a sum of these terms, with declared parameters, units and symbols.

    Args:
        port: "cart" [N] or "arm" [N m].
        variable: of `VARIABLES`.
        terms: one or more.
        slow: below which a sign fades [unit of the variable], or for "against the motion" the speed below which friction does.

    Raises:
        ValueError: an unknown port or variable, or no term.
    """
    if port not in PORTS or variable not in VARIABLES or not terms:
        raise ValueError(
            f"formula: {port!r}, {variable!r} and {len(terms)} term(s); give a port, a variable and terms."
        )
    base = variable.split(",")[0]
    symbol, unit = _SYMBOLS[base], VARIABLE_UNITS[base]
    each = f"({unit})" if "/" in unit else unit
    fields: dict[str, Any] = {}
    for place, term in enumerate(terms, 1):
        power = term.number if term.kind in ("power", "odd") else int(term.kind == "peak")
        per = "" if not power else f"/{each}" if power == 1 else f"/{each}^{power}"
        fields[f"coefficient_{place}"] = parameter(
            symbol=f"c_{place}", unit=PORT_UNITS[port] + per, meaning=f"coefficient of {term.text(symbol, place) or '1'}",
            null=0.0, plausible=1.0,
        )  # fmt: skip
        if term.shaped:
            scaled = term.kind in _SCALED
            fields[f"shape_{place}"] = parameter(
                symbol=f"{'s' if scaled else 'k'}_{place}", unit=unit if scaled else f"rad/{each}",
                meaning="scale" if scaled else "wave number", bounds=(0.0, np.inf), plausible=1.0,
            )  # fmt: skip
    against = "" if "," not in variable else f" × (-sign({_SYMBOLS[base]}'))"
    equation = " + ".join(f"c_{n} {term.text(symbol, n)}".strip() for n, term in enumerate(terms, 1))
    told = hashlib.sha256(repr((port, variable, terms, slow)).encode()).hexdigest()[:6]
    space = {
        "__annotations__": dict.fromkeys(fields, Any), "__module__": __name__, "id": _named(port, variable, terms), "port": port,
        "equation": f"({equation}){against}" if against else equation, "variable": variable, "terms": terms, "slow": slow,
        "made_by": (formula_class, (port, variable, terms, slow)),
        "__doc__": f"A force on the {port}: {equation}{against}.", **fields,
    }  # fmt: skip
    made: Any = type(FormulaForce)
    return made(f"Formula_{told}", (FormulaForce,), space)
