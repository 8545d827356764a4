"""The unit that the name of a foreign file's column states, and the spellings of units."""

import re
from collections.abc import Mapping

import numpy as np

# Factor from a unit that a file may use to the unit of the layout.
FACTORS: Mapping[str, Mapping[str, float]] = {
    "A": {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": np.pi / 180, "rev/s": 2 * np.pi, "rpm": np.pi / 30},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "rev": 2 * np.pi},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
}
_SPELLINGS = {
    "inch": "in",
    "inches": "in",
    "µm": "um",
    "μm": "um",
    "°": "deg",
    "°/s": "deg/s",
    "µs": "us",
    "μs": "us",
    "µA": "uA",
    "μA": "uA",
    "1/min": "rpm",
    "U/min": "rpm",
    "r/min": "rpm",
    "RPM": "rpm",
}
# Units that are written out, without the s of a plural.
_WRITTEN_OUT = {
    "second": "s", "sec": "s", "millisecond": "ms", "millisec": "ms", "msec": "ms", "microsecond": "us", "microsec": "us",
    "usec": "us", "degree": "deg", "radian": "rad", "milliradian": "mrad", "revolution": "rev", "turn": "rev", "meter": "m",
    "metre": "m", "millimeter": "mm", "millimetre": "mm", "centimeter": "cm", "centimetre": "cm", "micrometer": "um",
    "micrometre": "um", "ampere": "A", "amp": "A", "milliampere": "mA", "milliamp": "mA", "newton": "N", "millinewton": "mN",
}  # fmt: skip
_IN_BRACKETS = re.compile(r"^(?P<column>.*?)\s*\[(?P<unit>[^\[\]]*)\]$")
# A unit at the end of a column's name, in round brackets, after an underscore or after "in".
_AT_THE_END = re.compile(r"(?:\((?P<within>[^()]*)\)|(?:_| in )(?P<after>(?:m?rad|deg|rev)_s|[^_\s()]+))$")
# What drives and sensors are read in that have no unit of the layout.
_FOREIGN = re.compile(r"^(m?V|%|g|counts?|cts|steps?|ticks?|pulses?|pwm|lsb|duty)(/s|/min|/rev)?$", re.IGNORECASE)
# After an underscore these are units less often than something else, as in "current_in" and "x_cm", the centre of mass.
_WORDS = ("in", "rev", "cm", "turn", "turns")


def usual_spelling(unit: str) -> str:
    """Return a unit as the table of factors spells it."""
    parts = [_WRITTEN_OUT.get(part.strip().lower().removesuffix("s"), part.strip()) for part in unit.split("/")]
    meant = "/".join(parts)
    return _SPELLINGS.get(unit, _SPELLINGS.get(meant, meant))


def name_and_unit(column: str) -> tuple[str, str]:
    """Return the name of a column such as "x [mm]" without the unit in square brackets, and that; nothing where there is none."""
    match = _IN_BRACKETS.match(column.strip())
    return (match["column"], match["unit"].strip()) if match else (column.strip(), "")


def foreign_unit(column: str) -> str:
    """Return the unit that no channel has and that ends a column's name in round brackets, as "Voltage (V)"; nothing for none."""
    match = _AT_THE_END.search(column)
    within = "" if match is None else (match["within"] or "").strip()
    return within if _FOREIGN.match(within) else ""


def ending_unit(column: str, quantity: str) -> str:
    """Return the unit in which a column's name ends, as in "x (mm)" or "speed_rpm"; nothing where it is none, or may be a word.

    In round brackets one of another quantity is returned, too, as it contradicts the channel.

    Args:
        column: its name.
        quantity: that it should be of, by its unit in the layout.
    """
    match = _AT_THE_END.search(column)
    if match is None:
        return ""
    within, after = match["within"], match["after"]
    unit = (within if after is None else after.replace("_", "/")).strip()
    meant = usual_spelling(unit)
    if within is not None:
        return unit if any(meant in known for known in FACTORS.values()) else ""
    return unit if meant in FACTORS[quantity] and unit not in _WORDS else ""
