"""What all figures of the project share: colours, style, estimates with their intervals, and how they are saved.

Figures are `matplotlib.figure.Figure`s of their own: pyplot and its global state stay out, so they
can be made in a library, a server or a test alike. Colours are those of Okabe and Ito (2008), which
stay apart for colour-blind readers.
"""

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import offset_copy
from numpy.typing import ArrayLike, NDArray

from scb.statistics import Estimate, Statistic, estimate, iqm

BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
GREY = "#555555"

WIDTH = 9.0  # inches; a page shows them at about 100 px an inch, so 10 pt are 14 px
DPI = 200
CHARACTERS = 10  # an inch, of a title in bold 11 pt

_STYLE: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "figure.constrained_layout.use": True,
    "figure.facecolor": "white",
    "font.size": 10,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "legend.handlelength": 3.0,
    "lines.linewidth": 1.8,
    "lines.markersize": 5.0,
    "savefig.dpi": DPI,
}


@dataclass(frozen=True)
class Look:
    """How one thing is drawn wherever it appears; marker and line style tell it apart in grey too."""

    color: str
    linestyle: Any = "-"
    marker: str = ""


# Lines of one figure, of which no two are alike in grey either.
LINES = (
    Look(BLACK, "-"),
    Look(ORANGE, "--"),
    Look(BLUE, "-."),
    Look(VERMILLION, ":"),
    Look(GREEN, (0, (3, 1, 1, 1))),
    Look(PURPLE, (0, (5, 1))),
)


def estimate_row(
    axes: Axes, position: float, values: NDArray[np.floating], found: Estimate, color: str
) -> None:
    """On one line of a horizontal plot: the estimate with its interval, and just below it each value a dot."""
    below = offset_copy(axes.transData, axes.get_figure(root=True), y=-5, units="points")
    level = np.full(values.size, position)
    axes.plot(values, level, ".", color=color, alpha=0.4, markeredgewidth=0, transform=below)
    # What is drawn with an offset does not count for the axes' limits, and outliers would be outside.
    axes.update_datalim(np.column_stack([values, level]), updatey=False)
    axes.errorbar(
        found.value,
        position,
        xerr=error_bar(found),
        fmt="o",
        color=color,
        capsize=3,
    )


def name_rows(axes: Axes, names: Iterable[str]) -> None:
    """Of a horizontal plot, whose rows are at 0, 1, ...: the first is on top."""
    names = list(names)
    axes.set_yticks(range(len(names)), names)
    axes.yaxis.set_inverted(True)


def error_bar(*found: Estimate) -> NDArray[np.floating]:
    """[2, N] distances of the intervals' ends from the values, as matplotlib takes them; 0 where an end is unknown."""
    values = np.array([e.value for e in found])
    ends = [[e.value if x is None else x for x in (e.low, e.high)] for e in found]
    return np.abs(np.transpose(ends) - values)


def panels(figure: Figure, number: int, columns: int = 2) -> list[Axes]:
    """As many panels, so many a row; what is left of the last row stays empty."""
    found = list(figure.subplots(-(-number // columns), columns, squeeze=False).ravel())
    for axes in found[number:]:
        axes.axis("off")
    return found[:number]


def search_curve(
    axes: Axes,
    curves: Sequence[Mapping[str, Any]],
    label: str,
    look: Look,
    statistic: Statistic = np.mean,
) -> None:
    """Several searches over their generations: a statistic of them, with its interval over searches.

    Args:
      curves: of each search {"generation": [G], "fitness": [G] with None where there is no number}. A generation
        without any number is a gap in the line; the interval needs two searches.
      statistic: takes an array and `axis`.
    """
    if not curves:
        return
    found = over_searches([c["fitness"] for c in curves], statistic)
    estimate_curve(axes, curves[0]["generation"], found, look, label)


def over_searches(
    values: Sequence[Sequence[float | None]], statistic: Statistic = iqm
) -> list[Estimate]:
    """At each of G points the statistic of several searches' [G] values that are numbers; NaN where none is."""
    columns = np.array(values, float).T
    return [
        Estimate(np.nan, None, None, 0)
        if np.isnan(column).all()
        else estimate(column[~np.isnan(column)], statistic)
        for column in columns
    ]


def estimate_curve(
    axes: Axes,
    x: ArrayLike,
    found: Sequence[Estimate],
    look: Look,
    label: str | None = None,
) -> None:
    """A line through estimates, their intervals a band where there are any."""
    middle = np.array([e.value for e in found])
    below, above = error_bar(*found)
    axes.plot(x, middle, label=label, **vars(look))
    if any(e.low is not None for e in found):
        axes.fill_between(
            x, middle - below, middle + above, color=look.color, alpha=0.15, linewidth=0
        )


@contextmanager
def figure_style() -> Iterator[None]:
    """The context in which every figure of the project is drawn."""
    # "default" first: a reader's own matplotlibrc must not change the figures of a run.
    with matplotlib.style.context(["default", _STYLE]):
        yield


def figure_title(figure: Figure, text: str) -> None:
    """The title of the whole figure, on the left, in as many lines as it takes."""
    wrapped = textwrap.fill(text, round(CHARACTERS * figure.get_figwidth()))
    figure.suptitle(wrapped, x=0.01, ha="left", fontsize=11, fontweight="bold")


def legend_below(figure: Figure, entries: tuple[list[Any], list[Any]], columns: int) -> None:
    """One legend for the whole figure, outside the axes, where it can cover no data."""
    figure.legend(*entries, loc="outside lower center", ncols=columns, columnspacing=1.5)


def legend_of(figure: Figure, looks: Mapping[str, Look | Mapping[str, Any]], columns: int) -> None:
    """`legend_below` of lines, given by label, or as what `Line2D` takes."""
    drawn = [vars(look) if isinstance(look, Look) else look for look in looks.values()]
    handles = [Line2D([], [], **look) for look in drawn]
    legend_below(figure, (handles, list(looks)), columns)


def save(figure: Figure, path: str | Path, dpi: int = DPI) -> Path:
    """Writes a PNG whose bytes depend on the figure alone: no date, no version in its metadata."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with figure_style():
        figure.savefig(path, format="png", dpi=dpi, metadata={"Software": None})
    return path


def ratio_text(bandit: float, environment: float) -> str:
    """How a bandit's steps compare with an environment's, in words: "120 times fewer"."""
    if bandit <= 0 or environment <= 0:
        return ""
    if bandit == environment:
        return "the same"
    ratio = max(bandit, environment) / min(bandit, environment)
    number = thousands(ratio) if ratio >= 10 else f"{ratio:.2g}"
    return f"{number} times {'fewer' if bandit < environment else 'more'}"


def thousands(x: float) -> str:
    """A count with its digits in groups of three, which no line break parts."""
    return f"{x:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")
