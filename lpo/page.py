"""Objectives as a page to move: what each gains from a ratio, and what it leaves of the surrogate's gradient."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lpo.figures import looks
from lpo.objectives import Objective
from lpo.update_regions import ADVANTAGES, RATIOS, REGIONS, analyze, midpoints
from scb.agents.drift import USUAL_CLIP
from scb.interactive import plotly, save_page, slider

STEPS = np.delete(np.linspace(*ADVANTAGES, 25), 12)  # advantages of the slider, without the 0
FIRST = 15  # +1


def save_objective_page(path: Path, objectives: Sequence[Objective], progress: float) -> Path:
    """Writes a page that compares objectives.

    Args:
      path: of the file.
      objectives: the last one is what the page is about; the others stand beside it.
      progress: fraction of training done, for drifts that depend on it.
    """
    low, high = np.log(RATIOS)
    log_ratios = midpoints(low, high, 160)
    found = [analyze(o, progress, log_ratios, STEPS) for o in objectives]
    grid = midpoints(low, high, 60), midpoints(*ADVANTAGES, 60)
    surfaces = [analyze(o, progress, *grid) for o in objectives]
    name = objectives[-1].name
    when = f", {progress:.0%} of the training done" if objectives[-1].drift.temporal else ""
    return save_page(
        path,
        f"{name}: what it does to an update",
        f"PPO maximises the mean of ratio · advantage − drift. {name} beside the others{when}.",
        {
            "One sample: move its advantage": (
                "Left, what the objective gains when the policy makes an action more or less likely than it was (the "
                "ratio). Right, how much of the plain surrogate's gradient is left there: 1 is all of it, 0 stops the "
                "update, below 0 it moves the policy back. Point at a curve to read it in words; dotted is PPO's clip.",
                _curves(log_ratios, found),
            ),
            "The penalty over ratio and advantage: turn it": (
                "The drift, zero where nothing is charged. Its axes are the ratio, in logarithms, and the advantage in "
                "standard deviations of a minibatch.",
                _surfaces(surfaces),
            ),
        },
    )


def _curves(log_ratios: Any, found: Sequence[Any]) -> Any:
    from plotly.subplots import make_subplots

    go = plotly()
    ratios = np.exp(log_ratios)
    regions = list(REGIONS)
    colors = looks([analysis.objective for analysis in found])
    figure = make_subplots(
        rows=1,
        cols=2,
        subplot_titles=("ratio · advantage − drift, less its value at 1", "share of the gradient"),
    )
    gains, shares, words = [], [], []
    for analysis in found:
        surrogate = np.expm1(log_ratios) * analysis.advantages[:, None]
        gains.append(np.round(surrogate - analysis.drift, 4))
        shares.append(np.round(np.clip(analysis.relative, -1.5, 2.5), 4))
        words.append([[regions[i] for i in row] for row in analysis.regions])
    for column, values in enumerate((gains, shares), 1):
        for i, analysis in enumerate(found):
            figure.add_trace(
                go.Scatter(
                    x=ratios,
                    y=values[i][FIRST],
                    text=words[i][FIRST],
                    name=analysis.objective,
                    legendgroup=analysis.objective,
                    showlegend=column == 1,
                    hovertemplate="%{y:.3f} (%{text})",
                    line={"color": colors[analysis.objective].color, "width": 2.5},
                ),
                row=1,
                col=column,
            )
    lowest, highest = (float(f(np.asarray(gains))) for f in (np.min, np.max))
    figure.update_yaxes(range=(1.05 * lowest, 1.05 * highest), row=1, col=1)
    figure.update_yaxes(range=(-1.5, 2.5), row=1, col=2)
    figure.update_xaxes(
        type="log", title="ratio", tickvals=[0.5, 0.8, 1.0, 1.2, 2.0], range=np.log10(RATIOS)
    )
    for ratio in (1.0 - USUAL_CLIP, 1.0, 1.0 + USUAL_CLIP):
        figure.add_vline(ratio, line={"color": "#999", "dash": "dot", "width": 1})
    for level in (0.0, 1.0):
        figure.add_hline(level, line={"color": "#bbb", "width": 1}, row=1, col=2)
    figure.update_layout(
        height=480,
        hovermode="x unified",
        margin={"l": 10, "r": 10, "t": 40, "b": 10},
        legend={"orientation": "h", "y": 1.18, "x": 0},
        sliders=[
            slider(
                "advantage (standard deviations)",
                [
                    (
                        f"{advantage:+.3g}",
                        {
                            "y": [v[step] for v in (*gains, *shares)],
                            "text": [w[step] for w in (*words, *words)],
                        },
                    )
                    for step, advantage in enumerate(STEPS)
                ],
                FIRST,
            )
        ],
    )
    return figure


def _surfaces(found: Sequence[Any]) -> Any:
    go = plotly()
    # An extreme corner of one must not make the others look flat.
    highest = max(float(np.quantile(analysis.drift, 0.99)) for analysis in found) or 1.0
    last = len(found) - 1
    figure = go.Figure(
        [
            go.Surface(
                x=np.exp(analysis.log_ratios),
                y=analysis.advantages,
                z=np.round(analysis.drift, 4),
                cmin=0.0,
                cmax=highest,
                colorscale="Magma",
                reversescale=True,
                colorbar={"title": "drift", "len": 0.7},
                visible=i == last,
            )
            for i, analysis in enumerate(found)
        ]
    )
    figure.update_layout(
        height=620,
        margin={"l": 0, "r": 0, "t": 30, "b": 0},
        scene={
            "xaxis": {"title": "ratio", "type": "log", "tickvals": [0.5, 0.8, 1.0, 1.2, 2.0]},
            "yaxis": {"title": "advantage"},
            "zaxis": {"title": "drift", "range": (0.0, highest)},
            "aspectratio": {"x": 1.2, "y": 1.2, "z": 0.7},
            "camera": {"eye": {"x": -1.6, "y": -1.7, "z": 1.2}},
        },
        updatemenus=[
            {
                "type": "buttons",
                "direction": "right",
                "x": 0.0,
                "xanchor": "left",
                "y": 1.05,
                "active": last,
                "buttons": [
                    {
                        "label": analysis.objective,
                        "method": "restyle",
                        "args": [{"visible": [i == j for j in range(len(found))]}],
                    }
                    for i, analysis in enumerate(found)
                ],
            }
        ],
    )
    return figure
