"""Figures of drifts: what they charge, and what they do to the update, over ratio and advantage."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from lpo.update_regions import REGIONS, analyze
from scb.agents.drift import USUAL_CLIP
from scb.errors import UserError
from scb.plotting import (
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    WIDTH,
    figure_style,
    figure_title,
    legend_below,
)

if TYPE_CHECKING:
    from lpo.objectives import Objective

_RATIO = r"ratio $r = \pi(a|s)\,/\,\pi_{\mathrm{old}}(a|s)$"
_ADVANTAGE = "advantage A\n(standard deviations)"
# Of `lpo.update_regions.REGIONS`. What stops or turns an update is dark, what leaves it alone is pale.
_REGION_COLORS = {
    "rolls back": VERMILLION,
    "flat": GREY,
    "cautious": ORANGE,
    "free": "#F2F2F2",
    "optimistic": SKY_BLUE,
    "amplified": GREEN,
    "hindered": PURPLE,
}


def drift_and_gradient(
    objectives: "Sequence[Objective]", progress: Sequence[float] = (0.0, 0.5, 1.0)
) -> Figure:
    """What objectives charge, where that lets a policy move, and what it amounts to.

    A row an objective; one that changes over the training has a row for each of its fractions.
    Columns: the drift f, the gradient d/d(log r) (r A - f), and the regions of
    `lpo.update_regions.REGIONS`. The panels of a column share one scale.

    Args:
      objectives: from top to bottom.
      progress: fractions of training done, for drifts that depend on it.
    """
    if not objectives:
        raise UserError("there are no objectives to draw: give at least one.")
    rows = [
        (
            o.name if len(fractions) == 1 else f"{o.name}\n{100 * fraction:g} % of training",
            analyze(o, fraction),
        )
        for o in objectives
        for fractions in [progress if o.drift.temporal else (0.5,)]
        for fraction in fractions
    ]
    names = list(REGIONS)
    with figure_style():
        figure = Figure(figsize=(WIDTH, 1.7 + 1.9 * len(rows)))
        grid = figure.subplots(len(rows), 3, sharex=True, sharey=True, squeeze=False)
        penalty, direction = _scales([a.drift for _, a in rows], [a.gradient for _, a in rows])
        classes = ListedColormap([_REGION_COLORS[name] for name in names])
        for row, (label, analysis) in zip(grid, rows, strict=True):
            ratios, advantages = np.exp(analysis.log_ratios), analysis.advantages
            penalty.draw(row[0], ratios, advantages, analysis.drift)
            direction.draw(row[1], ratios, advantages, analysis.gradient)
            row[2].pcolormesh(
                ratios,
                advantages,
                analysis.regions,
                cmap=classes,
                norm=Normalize(-0.5, len(names) - 0.5),
                shading="nearest",
                rasterized=True,
            )
            for axes in row:
                for x, linestyle in ((1.0, "-"), (1.0 - USUAL_CLIP, ":"), (1.0 + USUAL_CLIP, ":")):
                    axes.axvline(x, color=GREY, linewidth=0.9, linestyle=linestyle)
                axes.axhline(0.0, color=GREY, linewidth=0.9)
                axes.grid(visible=False)
            row[0].set_ylabel(_ADVANTAGE, fontsize=9)
            row[0].annotate(
                label,
                (-0.36, 0.5),
                xycoords="axes fraction",
                rotation=90,
                ha="right",
                va="center",
                fontweight="bold",
            )
        grid[0, 0].set_xscale("log")
        grid[0, 0].set_xticks([0.5, 0.8, 1.0, 1.2, 2.0], ["0.5", "0.8", "1", "1.2", "2"])
        grid[0, 0].xaxis.set_minor_locator(NullLocator())
        for axes, title in zip(
            grid[0],
            ("drift f (penalty)", "gradient d/d(log r) (r A − f)", "what that amounts to"),
            strict=True,
        ):
            axes.set_title(title, fontsize=10, weight="normal")
        for axes in grid[-1]:
            axes.set_xlabel(_RATIO)
        for column, scale in enumerate((penalty, direction)):
            scale.bar(figure, grid[:, column], location="bottom", aspect=18)
        # The third column has its legend where the others have their scales.
        shown = [n for i, n in enumerate(names) if any((a.regions == i).any() for _, a in rows)]
        handles = [
            *(Patch(facecolor=_REGION_COLORS[n], edgecolor=GREY, linewidth=0.6) for n in shown),
            Line2D([], [], color=GREY, linewidth=0.9, linestyle=":"),
        ]
        figure_title(figure, "What a drift charges, and what it does to the update")
        legend_below(figure, (handles, [*shown, "PPO's clip, 0.2"]), columns=4)
    return figure


class _Scale:
    """A colour scale that several panels share; its bar is pointed at `extend` where one has more."""

    def __init__(self, colors: Any, norm: Normalize, extend: str) -> None:
        self.map, self.norm, self.extend, self.covers = colors, norm, extend, True

    def draw(
        self,
        axes: Axes,
        x: NDArray[np.floating],
        y: NDArray[np.floating],
        values: NDArray[np.floating],
    ) -> None:
        axes.pcolormesh(
            x, y, values, cmap=self.map, norm=self.norm, shading="gouraud", rasterized=True
        )
        self.covers &= bool(np.abs(values).max() <= (self.norm.vmax or 0.0))

    def bar(self, figure: Figure, panels: NDArray[Any], **how: Any) -> Colorbar:
        extend = "neither" if self.covers else self.extend
        mappable = ScalarMappable(self.norm, self.map)
        return figure.colorbar(mappable, ax=list(panels), extend=extend, pad=0.02, **how)


def _scales(
    drifts: Sequence[NDArray[np.floating]], gradients: Sequence[NDArray[np.floating]]
) -> tuple[_Scale, _Scale]:
    """Of penalties, pale where there is none, and of gradients, pale at zero."""
    # The dark end of the map is cut off: contours would drown in it.
    pale_is_none = LinearSegmentedColormap.from_list(
        "drift", colormaps["magma_r"](np.linspace(0.0, 0.85, 256))
    )
    largest = _largest([np.abs(g) for g in gradients])
    return (
        _Scale(pale_is_none, Normalize(0.0, _largest(drifts)), "max"),
        _Scale(colormaps["RdBu_r"], Normalize(-largest, largest), "both"),
    )


def _largest(surfaces: Sequence[NDArray[np.floating]]) -> float:
    # One extreme corner of one objective must not make the others look flat; the pointed end of the
    # colour bar says that there is more.
    values = np.concatenate([s.ravel() for s in surfaces])
    largest, usual = float(values.max()), float(np.quantile(values, 0.99))
    bound = largest if largest <= 1.5 * usual else usual
    return bound if bound > 0 else 1.0
