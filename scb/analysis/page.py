"""What a bandit knows, as a page to turn: its reward over a plane of states, and its best actions there."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scb import plotting
from scb.analysis.figures import BARS, action_colors, trajectory_line
from scb.analysis.planes import Plane
from scb.analysis.states import thinned
from scb.interactive import plotly, save_page, slider

POINTS = 64  # of the plane's grid in either direction
ACTIONS = 9  # values of a continuous action that the slider has
SHOWN = 400  # contexts, and visited states


def save_bandit_page(path: Path, parts: Mapping[str, Any]) -> Path:
    """Writes the page of `scb.analysis.figures.explained`'s parts.

    Args:
      path: of the file.
      parts: of `scb.analysis.explain.explain`.
    """
    plane: Plane = parts["plane"]
    x, y, observations = plane.grid(POINTS)
    values = (
        np.arange(parts["num_actions"])
        if parts["num_actions"]
        else np.linspace(parts["bounds"][0], parts["bounds"][1], ACTIONS)
    )
    shares = sorted(zip(parts["names"], parts["importance"], strict=True), key=lambda of: -of[1])
    reasons = ", ".join(f"{name} {share:.0%}" for name, share in shares[:BARS])
    if len(shares) > BARS:
        reasons += ", the others less"
    reward = (
        "The surface is the reward for the action that the slider chooses, or for the best one, in each state of the "
        "plane; what is not on its axes is held at what is usual. Points have their own rewards: they lie off the "
        f"surface where the rest of their observation differs. What the reward's variance comes from: {reasons}."
    )
    best = "The best action of each state, and an episode that takes it, in the environment. Point at it to read."
    return save_page(
        path,
        f"{parts['name']}: its reward and its best actions",
        f"{parts['name']}: {parts['summary']}.",
        {
            "Reward over states: turn it": (reward, _surface(parts, x, y, observations, values)),
            "Best actions": (best, _best_actions(parts, x, y, observations)),
        },
    )


def _surface(parts: Mapping[str, Any], x: Any, y: Any, observations: Any, values: Any) -> Any:
    go = plotly()
    plane: Plane = parts["plane"]
    clouds = {
        "contexts of the bandit": (parts["contexts"][:SHOWN], plotting.SKY_BLUE),
        "visited by its optimal policy": (thinned(parts["visited"], SHOWN), plotting.VERMILLION),
    }

    texts = ["the best", *(f"{value:.3g}" for value in values)]

    def rewards(states: Any) -> list[np.ndarray]:
        """Of the states, at each position of the slider."""
        found = parts["rewards"](states, values.tolist())
        return [np.round(np.asarray(x, float), 4) for x in found]

    surfaces = [x.reshape(POINTS, POINTS) for x in rewards(observations)]
    heights = {name: rewards(points) for name, (points, _) in clouds.items()}
    positions = [list(z) for z in zip(surfaces, *heights.values(), strict=True)]
    low, high = float(np.min(surfaces)), float(np.max(surfaces))
    traces = [
        go.Surface(
            x=x,
            y=y,
            z=surfaces[0],
            cmin=low,
            cmax=high,
            colorscale="Viridis",
            colorbar={"title": "reward", "len": 0.7},
            opacity=0.9,
        )
    ]
    for name, (points, color) in clouds.items():
        a, b = plane.project(points).T
        marker = {"size": 2, "color": color}
        traces.append(
            go.Scatter3d(x=a, y=b, z=heights[name][0], mode="markers", name=name, marker=marker)
        )
    figure = go.Figure(traces)
    figure.update_layout(
        height=720,
        margin={"l": 30, "r": 0, "t": 10, "b": 40},
        legend={"x": 0, "y": 1, "itemsizing": "constant"},
        scene={
            "xaxis": {"title": plane.labels[0], "range": plane.limits[0]},
            "yaxis": {"title": plane.labels[1], "range": plane.limits[1]},
            "zaxis": {"title": "reward"},
            "aspectratio": {"x": 1.2, "y": 1.2, "z": 0.8},
            "camera": {"eye": {"x": 1.6, "y": 1.7, "z": 1.2}},
        },
        sliders=[
            slider(
                parts["action"],
                [(text, {"z": z}) for text, z in zip(texts, positions, strict=True)],
                0,
            )
        ],
    )
    return figure


def _best_actions(parts: Mapping[str, Any], x: Any, y: Any, observations: Any) -> Any:
    go = plotly()
    plane: Plane = parts["plane"]
    number = parts["num_actions"]
    if number:
        # One band of colour an action, without blending.
        edges = np.arange(number + 1) / number
        colors = [
            (float(edge), color)
            for i, color in enumerate(action_colors(number))
            for edge in edges[i : i + 2]
        ]
        scale = {
            "zmin": -0.5,
            "zmax": number - 0.5,
            "colorscale": colors,
            "colorbar": {"title": parts["action"], "tickvals": list(range(number))},
        }
    else:
        low, high = parts["bounds"]
        scale = {
            "zmin": low,
            "zmax": high,
            "colorscale": "PuOr",
            "colorbar": {"title": parts["action"]},
        }
    episode = trajectory_line(plane, parts["episode"])
    figure = go.Figure(
        [
            go.Heatmap(x=x, y=y, z=parts["best"](observations).reshape(POINTS, POINTS), **scale),
            go.Scatter(
                x=episode[:, 0],
                y=episode[:, 1],
                mode="lines+markers",
                name="an episode",
                line={"color": plotting.BLACK, "width": 1},
                marker={"size": 4},
            ),
        ]
    )
    figure.update_layout(
        height=520,
        margin={"l": 0, "r": 0, "t": 10, "b": 0},
        xaxis={"title": plane.labels[0], "range": plane.limits[0]},
        yaxis={"title": plane.labels[1], "range": plane.limits[1]},
        showlegend=False,
    )
    return figure
