"""Charts as inline SVG: drawn by matplotlib, coloured by the page's style sheet, with a text and a table beside them.

Colours that matplotlib draws with are only markers: `_shorten` turns them into variables of the style sheet, so that
a chart follows the page from light to dark. Names that users chose stand in the page's legend, never in the picture,
except the labels of bars; those are drawn without math.
"""

from __future__ import annotations

import io
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullFormatter

WIDTH, HEIGHT = 360, 200
"""Size of a chart in pixels of the page: as wide as a phone, so that its text is not shrunk there."""
COLORS, DASHES = 6, ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))
"""Number of colours of the style sheet; further series have the same colours and other dashes."""
INK, GRID = "#010101", "#020202"
_SERIES = "#0300{:02x}"
_REFERENCE = re.compile(r"^#(\S+)$|url\(#([^)]+)\)")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "text.parse_math": False,
    "font.size": 11,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "path.simplify": True,
}


@dataclass(frozen=True)
class Chart:
    """A picture with a title, a description and a table for readers who do not see it."""

    key: str
    """Unique in a page; a word of letters and digits."""
    title: str
    description: str
    svg: Markup
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    legend: tuple[tuple[str, int], ...] = ()
    """Name and number of each series; empty if there is only one."""


class Scale(NamedTuple):
    """Format and spacing of the numbers of an axis."""

    write: Callable[[float], str]
    limits: tuple[float, float] | None = None
    log: bool = False


class Line(NamedTuple):
    """A line of a chart: its series, x, y, and optionally a band and thin lines behind it."""

    series: int
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    thin: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    steps: bool = False
    """True if y is constant from each x to the next, as in a histogram."""


def plain(value: float) -> str:
    """Return a number with three digits that count; "-" if it is unknown."""
    if not np.isfinite(value):
        return "-"
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:z.3g}"


def percent(value: float) -> str:
    """Return a share in percent; "-" if it is unknown."""
    return "-" if not np.isfinite(value) else f"{value:z.1%}"


SHARE = Scale(percent, (-0.02, 1.02))
NUMBER = Scale(plain)


class Text(NamedTuple):
    """A picture with its title, a description in sentences, the legend, and its data as a table."""

    title: str
    description: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    legend: Sequence[tuple[str, int]] = ()


class Drawing:
    """Makes the charts of one page; each gets a key of its own."""

    def __init__(self) -> None:
        self._count = 0

    def lines(self, text: Text, lines: Sequence[Line], x: Scale, y: Scale, x_label: str) -> Chart:
        """Draw lines; `x_label` is not a name that a user chose."""
        figure, axis = _axes(x_label, HEIGHT, left=0.17)
        with rc_context(_STYLE):
            for line in lines:
                style: dict[str, Any] = {"color": series_color(line.series), "linestyle": dash(line.series)}
                for thin_x, thin_y in line.thin:
                    axis.plot(thin_x, thin_y, color=style["color"], linewidth=0.8, alpha=0.45)
                if line.band is not None:
                    axis.fill_between(line.x, *line.band, color=style["color"], alpha=0.2, linewidth=0)
                if line.steps:
                    axis.stairs(line.y, line.x, linewidth=1.6, **style)
                    axis.stairs(line.y, line.x, fill=True, alpha=0.15, color=style["color"])
                else:
                    axis.plot(
                        line.x, line.y, linewidth=2, marker="o" if len(line.x) == 1 else None, markersize=4, **style
                    )
            _scale(axis, "x", x)
            _scale(axis, "y", y)
        return self._chart(figure, text)

    def bars(self, text: Text, labels: Sequence[str], values: np.ndarray, bounds: np.ndarray, scale: Scale) -> Chart:
        """Draw horizontal bars.

        Args:
            text: beside the picture.
            labels: of the rows, from the top.
            values: [rows, series]; NaN for none.
            bounds: [rows, series, 2], their intervals; NaN for none.
            scale: of the values.
        """
        rows, series = values.shape
        figure, axis = _axes("", 34 + rows * max(22, 10 * series), left=0.28)
        with rc_context(_STYLE):
            width = 0.8 / series
            for number in range(series):
                at = np.arange(rows) + (number - (series - 1) / 2) * width
                axis.barh(at, values[:, number], width * 0.9, color=series_color(number), alpha=0.75)
                axis.hlines(at, bounds[:, number, 0], bounds[:, number, 1], color=INK, linewidth=1.4)
            axis.set_yticks(np.arange(rows), [_printable(_short(label)) for label in labels])
            axis.set_ylim(rows - 0.4, -0.6)
            axis.grid(False, axis="y")
            _scale(axis, "x", scale)
        return self._chart(figure, text)

    def _chart(self, figure: Figure, text: Text) -> Chart:
        self._count += 1
        key = f"c{self._count}"
        rows = tuple(tuple(row) for row in text.rows)
        svg = _inline(figure, key, text.title, text.description)
        return Chart(key, text.title, text.description, svg, tuple(text.head), rows, tuple(text.legend))


def _axes(x_label: str, height: int, left: float) -> tuple[Figure, Axes]:
    with rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH / 72, height / 72))
        figure.patch.set_visible(False)
        below, above = (40 if x_label else 26), 10
        axis = figure.add_axes((left, below / height, 0.97 - left, 1 - (below + above) / height))
        axis.patch.set_visible(False)
        axis.set_xlabel(x_label)
        axis.set_axisbelow(True)
        axis.grid(True, color=GRID, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(length=3)
    return figure, axis


def series_color(number: int) -> str:
    """Return the marker of a series' colour."""
    return _SERIES.format(number % COLORS)


def dash(number: int) -> Any:
    """Return how the line of a series is dashed."""
    return DASHES[number // COLORS % len(DASHES)]


def _scale(axis: Axes, which: str, scale: Scale) -> None:
    own = getattr(axis, f"{which}axis")
    if scale.log:
        getattr(axis, f"set_{which}scale")("log")
        low, high = scale.limits or getattr(axis, f"get_{which}lim")()
        own.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 30 * low else (1,)))
        own.set_minor_formatter(NullFormatter())
    else:
        whole = scale.limits == SHARE.limits
        own.set_major_locator(MultipleLocator(0.25) if whole else MaxNLocator(5 if which == "x" else 4))
    if scale.limits is not None:
        getattr(axis, f"set_{which}lim")(*scale.limits)
    if scale.write is percent:
        own.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:z.3g}%"))
    elif scale.log:
        own.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    else:
        low, high = getattr(axis, f"get_{which}lim")()
        large = max(abs(low), abs(high)) >= 1e4
        own.set_major_formatter(EngFormatter(sep="") if large else FuncFormatter(lambda value, _: f"{value:z.4g}"))


def _inline(figure: Figure, key: str, title: str, description: str) -> Markup:
    """Return a figure as SVG for an HTML page: without links to schemas, with ids that begin with `key`."""
    file = io.StringIO()
    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the browser has fonts of its own
        figure.savefig(file, format="svg", metadata={"Date": None})
    root = ElementTree.fromstring(file.getvalue())
    _strip(root)
    _prefix_ids(root, f"{key}-")
    for element in root.iter():
        element.attrib = {name: _shorten(name, value) for name, value in element.attrib.items()}
        element.tail = None
        if element.tag != "text":
            element.text = None
    for place, (name, text) in enumerate((("title", title), ("desc", description))):
        child = ElementTree.Element(name, {"id": f"{key}-{name}"})
        child.text = _printable(text)
        root.insert(place, child)
    view = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-labelledby": f"{key}-title {key}-desc"}
    root.attrib = {**view, "class": "chart"}
    return Markup(ElementTree.tostring(root, encoding="unicode"))  # ElementTree has escaped it


def _short(label: str) -> str:
    return label if len(label) <= 15 else f"{label[:14]}…"


def _printable(text: str) -> str:
    """Return a text without control characters, which XML cannot hold."""
    return "".join(character if character.isprintable() else " " for character in text)


def _strip(element: ElementTree.Element) -> None:
    """Remove namespaces, metadata and styles that would apply to the whole page."""
    for child in list(element):
        if _local(child.tag) in ("metadata", "style"):
            element.remove(child)
        else:
            _strip(child)
    element.tag = _local(element.tag)
    element.attrib = {_local(name): value for name, value in element.attrib.items()}


def _local(name: Any) -> str:
    return str(name).rpartition("}")[2]


def _prefix_ids(root: ElementTree.Element, prefix: str) -> None:
    """Give every id that something refers to a prefix, and remove the others."""
    values = [value for element in root.iter() for value in element.attrib.values()]
    names = {name for value in values for found in _REFERENCE.findall(value) for name in found if name}
    for element in root.iter():
        for name, value in list(element.attrib.items()):
            if name != "id":
                element.attrib[name] = _REFERENCE.sub(lambda found: found[0].replace("#", f"#{prefix}"), value)
            elif value in names:
                element.attrib["id"] = prefix + value
            else:
                del element.attrib["id"]


def _shorten(name: str, value: str) -> str:
    """Return an attribute in the page's colours and font, with coordinates to a tenth of a pixel."""
    if name in ("d", "x", "y", "width", "height", "transform", "points"):
        return re.sub(r"\s+", " ", re.sub(r"\d+\.\d{2,}", lambda found: f"{float(found[0]):.1f}", value)).strip()
    if name == "style":
        value = "; ".join(part for part in value.split("; ") if not part.startswith(("font", "stroke-linejoin")))
        value = re.sub(r"#0300([0-9a-f]{2})\b", lambda found: f"var(--s{int(found[1], 16)})", value)
        return value.replace(INK, "currentColor").replace(GRID, "var(--grid)")
    return value
