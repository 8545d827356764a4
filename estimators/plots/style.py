"""The common style of all pictures: units with prefixes, line styles that differ in print, thinning of long signals."""

import io
import re
import textwrap
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FuncFormatter, LogLocator, NullFormatter

Values = Float[np.ndarray, " sample"]

NAMES = {
    "cart_position": "cart position",
    "cart_velocity": "cart velocity",
    "arm_velocity": "arm velocity",
    "arm_angle": "arm angle",
    "current": "motor current",
    "disturbance_force": "disturbance force",
    "cart_position, against the motion": "cart position, opposing motion",
    "arm_angle, against the motion": "arm angle, opposing motion",
}
UNITS = {
    "cart_position": "m",
    "cart_velocity": "m/s",
    "arm_velocity": "rad/s",
    "arm_angle": "rad",
    "current": "A",
    "disturbance_force": "N",
    "cart_position, against the motion": "m",
    "arm_angle, against the motion": "rad",
}
MEASURED: dict[str, Any] = {"color": "0.65", "linewidth": 2.4, "linestyle": "-"}
# From light to dark, so that the order survives a black-and-white print.
MODELS: tuple[dict[str, Any], ...] = (
    {"color": "#e6550d", "linewidth": 1.1, "linestyle": "--"},
    {"color": "#08306b", "linewidth": 1.0, "linestyle": "-"},
    {"color": "#31a354", "linewidth": 1.0, "linestyle": "-."},
    {"color": "#756bb1", "linewidth": 1.0, "linestyle": ":"},
)
RESIDUALS: tuple[str, ...] = ("#fd8d3c", "#08306b", "#31a354", "#756bb1")
MARKERS = ("o", "s", "^")
HATCHES = ("", "///", "...")
NOISE: dict[str, Any] = {"color": "0.85", "linewidth": 0}
SMALL = 8

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
_MOST_POINTS = 2000
_DPI = 120  # a figure is as wide as a report at this, and its text stays sharp
_WIDEST_TITLE = 10.2  # characters per inch at the size of a title
_LONGEST_LABEL = 28  # characters beside an axis, which would else leave it no room
_LONGEST_LINE = 120  # of any other text
# What matplotlib's axes write as mathematics, and powers of ten of our own; whatever else holds a $ is a name.
_POWERED = re.compile(r"[A-Za-z]+(\^|²|³)")  # a unit whose first is a power: its prefix would be raised, too
_POWER = re.compile(r"\$(\\mathdefault\{)?[-−]?[0-9.]*(\\times)?(10\^\{[-−]?[0-9]+\})?\}?\$")


class Picture(Figure):
    """A figure that a notebook shows by itself; it needs no display and no pyplot."""

    def _repr_png_(self) -> bytes:
        return image_bytes(self, "png")

    def draw(self, renderer: Any) -> None:  # one that makes vectors is no `RendererBase`
        """Draw with names as they are written: no $ in one begins mathematics, and a long one is shortened."""
        _show_as_written(self)
        with warnings.catch_warnings():
            # A script that the font lacks shows as boxes, and the report beside the picture has it.
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            super().draw(renderer)


class Scaled(NamedTuple):
    """The factor for SI values, and the unit that they then have."""

    factor: float
    unit: str


def image_bytes(figure: Figure, kind: Literal["png", "svg"]) -> bytes:
    """Return the figure as the contents of an image file; the same figure gives the same bytes."""
    kept = io.BytesIO()
    dpi, canvas = figure.dpi, figure.canvas
    try:
        # By the canvas itself: `savefig` draws everything once more before, to look for where it ends.
        if kind == "png":
            figure.dpi = _DPI
            FigureCanvasAgg(figure).print_png(kept)
        else:
            FigureCanvasSVG(figure).print_svg(kept, metadata={"Date": None})
    finally:
        figure.dpi = dpi
        figure.set_canvas(canvas)
    figure.set_layout_engine("none")  # it is laid out now; to do so again for the next format takes as long as drawing
    return kept.getvalue()


def picture(width: float, height: float) -> Picture:
    """Return an empty figure of this size in inches, laid out so that labels do not overlap."""
    figure = Picture(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.06)  # type: ignore[union-attr] - figures here have an engine
    return figure


def prefixed(largest: float, unit: str) -> Scaled:
    """Return the SI prefix with which the largest value is between 1 and 1000; none before a unit such as 1/A or s^2."""
    if not np.isfinite(largest) or largest <= 0 or unit in ("1", "") or unit.startswith("1/") or _POWERED.match(unit):
        return Scaled(1.0, unit)
    if unit == "kg":
        size, gram = prefixed(1e3 * largest, "g")
        return Scaled(1.0, "kg") if largest >= 1 else Scaled(1e3 * size, gram)
    for size, prefix in _PREFIXES:
        if largest >= 0.9 * size:
            return Scaled(1 / size, prefix + unit)
    size, prefix = _PREFIXES[-1]
    return Scaled(1 / size, prefix + unit)


def axis(channel: str, *signals: np.ndarray) -> Scaled:
    """Return the scale for one channel that fits all these signals."""
    return prefixed(max((largest(s) for s in signals), default=1.0), UNITS[channel])


def largest(values: np.ndarray) -> float:
    """Return the largest absolute value that is finite, or zero."""
    found = np.abs(np.asarray(values, dtype=float))
    return float(np.max(found, where=np.isfinite(found), initial=0.0))


class _AsWritten(FuncFormatter):
    """Labels of ticks that were given as names: shortened, and without mathematics."""

    def __init__(self, given: FixedFormatter | FuncFormatter) -> None:
        super().__init__(lambda x, pos=None: _plain(given(x, pos)))


def _plain(text: str) -> str:
    return text if _POWER.fullmatch(text) else shortened(text, _LONGEST_LABEL).replace("$", r"\$")


def _show_as_written(figure: Figure) -> None:
    texts = figure.findobj(Text)  # which makes the ticks, too
    kept = set()
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        # What a formatter writes changes while it is drawn, so that the formatter, not the text, has to know.
        kept |= {id(part) for tick in (*axis.majorTicks, *axis.minorTicks) for part in (tick.label1, tick.label2)}
        formatter = axis.get_major_formatter()
        if isinstance(formatter, (FixedFormatter, FuncFormatter)) and not isinstance(formatter, _AsWritten):
            axis.set_major_formatter(_AsWritten(formatter))
    for text in texts:
        if isinstance(text, Text) and id(text) not in kept:
            text.set_parse_math(False)
            text.set_text("\n".join(shortened(_narrow(line), _LONGEST_LINE) for line in text.get_text().split("\n")))


def _narrow(line: str) -> str:
    """Return a line with every word shortened that no line could be broken in."""
    return re.sub(r"\S{40,}", lambda word: shortened(word[0], _LONGEST_LABEL), line)


def shortened(text: str, most: int) -> str:
    """Return text of at most so many characters: what is longer without its middle."""
    return text if len(text) <= most else f"{text[: most - most // 3 - 1]}…{text[-(most // 3) :]}"


def label(channel: str, unit: str) -> str:
    """Return name and unit for an axis."""
    name = NAMES[channel]
    return f"{name[0].upper()}{name[1:]} [{unit}]"


def thin(time: Values, values: Values) -> tuple[np.ndarray, np.ndarray]:
    """Return fewer points that look the same: of each stretch the smallest and the largest value, in their order."""
    if len(values) <= _MOST_POINTS:
        return time, values
    width = int(np.ceil(2 * len(values) / _MOST_POINTS))
    count = len(values) // width
    blocks = values[: count * width].reshape(count, width)
    filled = np.where(np.isfinite(blocks), blocks, np.inf)
    low = np.argmin(filled, axis=1)
    high = np.argmax(np.where(np.isfinite(blocks), blocks, -np.inf), axis=1)
    index = (np.arange(count) * width)[:, None] + np.sort(np.stack([low, high], axis=1), axis=1)
    index = np.append(index.ravel(), np.arange(count * width, len(values)))
    return time[index], values[index]


def worst_stretch(residual: Values, most: int = 1200, longest: int = _MOST_POINTS) -> slice:
    """Return the samples to look at closely in an experiment that is longer than this: where the residual is largest."""
    if len(residual) <= longest:
        return slice(0, len(residual))
    power = np.cumsum(np.concatenate([[0.0], np.nan_to_num(residual) ** 2]))
    first = int(np.argmax(power[most:] - power[:-most]))
    return slice(first, first + most)


def title(figure: Figure, text: str) -> None:
    """State the finding above the figure, broken into lines that fit, and not between a number and its percent sign."""
    text = _narrow(text).replace(" %", "\u00a0%")
    width = min(int(_WIDEST_TITLE * figure.get_figwidth()), _LONGEST_LINE)  # a longer line would lose its middle
    lines = textwrap.wrap(text, width)
    if len(lines) > 1:  # no line of a single word: as narrow as the same number of lines allows
        narrow = next(w for w in range(len(text) // len(lines), width + 1) if len(textwrap.wrap(text, w)) <= len(lines))
        lines = textwrap.wrap(text, narrow)
    figure.suptitle("\n".join(lines).replace("\u00a0%", " %"), fontsize=11, fontweight="bold")


def tidy(axes: Axes) -> None:
    """Give axes a light grid, small tick labels, and no frame where nothing is read off."""
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL)
    axes.spines[["top", "right"]].set_visible(False)


def plain_log_axis(axis: Axis, lowest: float, highest: float) -> None:
    """Label a logarithmic axis with plain numbers: at 1, 2 and 5 of every decade, or at 1 alone where these are many."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if highest < 50 * lowest else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def quantity(value: float, unit: str) -> str:
    """Format a number in two figures with its unit, as one reads it."""
    scale = prefixed(abs(value), unit)
    number = f"{float(f'{scale.factor * value:.2g}'):.6g}"
    return number if scale.unit in ("1", "") else f"{number} {scale.unit}".replace("^2", "²").replace("^3", "³")


def times(ratio: float) -> str:
    """Format a ratio in three figures."""
    return f"{ratio:.0f}" if ratio >= 100 else f"{ratio:.1f}" if ratio >= 10 else f"{ratio:.2f}"
