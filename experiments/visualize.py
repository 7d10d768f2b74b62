"""Agents that were trained in a bandit, acting in the environment: classic control as GIFs, Hopper as a page.

    python -m experiments.visualize

PPO agents train for 10 000 steps in each bandit of the zoo; the best of them by other episodes is
shown. The GIFs lie beside the page, Brax's viewer (which loads its script from the web) in
runs/visualize.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.brax_curriculum import STANDING
from experiments.page import CLASSIC_CONTROL, Experiment, Save, packed, table, text, unpacked
from experiments.page import main as run
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.analysis import animation
from scb.analysis.animation import picture, save_gif
from scb.analysis.states import follow
from scb.environments.registry import environment_spec
from scb.environments.zoo import open_bandit
from scb.errors import UserError
from scb.keys import root_key, split_key
from scb.statistics import estimate

HOPPER = "hopper (spring)"
FRAMES = 6  # of the film strip
PICTURES = 125  # of a GIF at most: five seconds
VIEWER = Path("runs/visualize/hopper.html")


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """An environment at a time: train, choose, record."""
    found = report.setdefault("environments", {})
    for name in (*CLASSIC_CONTROL, HOPPER):
        if name not in found:
            found[name] = _show(name, plan)
            save()
        elif name == HOPPER and not VIEWER.exists():
            _show(name, plan)  # for its page, which no report holds


def _show(name: str, plan: Mapping[str, Any]) -> dict[str, Any]:

    environment, backend = ("hopper", "spring") if name == HOPPER else (name, None)
    place = environment_spec(environment)
    env, env_params = place.make(backend)
    bandit = open_bandit(place.bandit)
    spec = bandit_agent("ppo", environment, sampled=False)
    agent = spec.agent(bandit)
    key_train, key_choose, key_show = split_key(root_key(plan["seed"]), 3)
    episodes = plan["brax_episodes" if place.backends else "episodes"]

    @jax.jit
    @jax.vmap
    def train(key: Any) -> Any:
        state = agent.train(key, spec.hyperparameters, bandit.default_params)
        found = agent.evaluate(state, key_choose, episodes, env, env_params, mode=True)
        return state, found.returns.mean()

    states, returns = train(split_key(key_train, plan["agents"]))
    if not np.isfinite(returns).all():
        raise UserError(f"an agent of {name} has no finite return: choose another seed.")
    best = int(np.argmax(returns))
    state = jax.tree.map(lambda x: x[best], states)

    def policy(observation: Any, key: Any) -> Any:
        return agent.act(state, observation, key, bandit.default_params, mode=True)

    entry: dict[str, Any] = {"agents": estimate(np.asarray(returns, float)).as_dict()}
    if name == HOPPER:
        _, shown = animation.save_brax_html(VIEWER, env, policy, key_show, plan["brax_steps"])
        return {**entry, "shown": round(shown, 1), "steps": plan["brax_steps"]}
    trajectories = follow(env, env_params, policy, key_show, 1)
    steps = len(trajectories.states())
    # Where the episode ends early, what it ends in follows its last step.
    observations = trajectories.observations[0, : steps + 1]
    pictures = sorted({*range(0, len(observations), plan["every"]), len(observations) - 1})
    return {
        **entry,
        "shown": round(float(trajectories.returns()[0]), 1),
        "steps": steps,
        "every": plan["every"],
        "film": packed(observations[pictures]),
    }


def film(entry: Mapping[str, Any]) -> np.ndarray:
    """[T, O] observations of an episode, every few steps, and the last."""
    return unpacked(entry["film"])


def animate(report: Mapping[str, Any], docs: Path) -> None:
    """Writes the GIFs."""
    for name, entry in report["environments"].items():
        if "film" in entry:
            path = docs / "figures" / f"visualize_{name}.gif"
            save_gif(path, name, film(entry)[:PICTURES], entry["every"])


def _number(value: float, places: int) -> str:
    return f"{value:.{places}f}".replace("-", "\u2212")


def _good(report: Mapping[str, Any]) -> list[str]:
    """Where agents earn at most a tenth less than the paper's SAC expert; on Hopper what standing still does."""

    def level(name: str) -> float:
        if name == HOPPER:
            return STANDING
        expert = environment_spec(name).reference_return()
        return expert - 0.1 * abs(expert)

    found = report["environments"].items()
    return [name for name, entry in found if entry["agents"]["value"] >= level(name)]


def parts(report: Mapping[str, Any]) -> list[bool]:
    """Environment by environment: whether agents do well."""
    good = _good(report)
    return [name in good for name in report["environments"]]


def verdict(report: Mapping[str, Any]) -> str:
    """What all agents earn, whether that is an expert's return, and what is seen."""
    found = report["environments"]
    good = _good(report)
    earned = "; ".join(f"{name} {text(entry['agents'])}" for name, entry in found.items())
    shown = "; ".join(f"{name} {_number(entry['shown'], 0)}" for name, entry in found.items())
    return (
        "agents that learned for 10 000 steps in a bandit, without one step of the environment, earn there "
        f"(interquartile mean): {earned}. That is the return of the paper's SAC expert or at most a tenth less in "
        f"{', '.join(good) or 'none'}; standing still would earn {STANDING:.0f} of Hopper. The episodes shown, of the "
        f"best of {report['plan']['agents']} agents: {shown}."
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """The GIFs and the table."""
    gifs = [
        f"![{name}: an agent trained in its bandit](figures/visualize_{name}.gif)"
        for name in report["environments"]
        if name != HOPPER
    ]
    rows = [
        [name, text(entry["agents"]), _number(entry["shown"], 1), str(entry["steps"])]
        for name, entry in report["environments"].items()
    ]
    return [
        " ".join(gifs),
        "",
        f"Hopper's episode (on `spring` physics) is in `{VIEWER}` after the command has run: a page with Brax's "
        "viewer.",
        "",
        *table(
            [
                "environment",
                "return of the agents, IQM [95 %]",
                "return of what is shown",
                "steps shown",
            ],
            rows,
        ),
        "",
        "PPO with the paper's fixed hyperparameters; the agent shown is the best of them by other episodes. Most "
        "likely actions. Acrobot's last step costs nothing.",
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """A film strip: a row an environment, from the first step to the last."""

    films = {n: e for n, e in report["environments"].items() if "film" in e}
    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 1.6 * len(films)))
        panels: Any = figure.subplots(len(films), FRAMES, squeeze=False)
        for row, (name, entry) in zip(panels, films.items(), strict=True):
            observations = film(entry)
            pictures = np.linspace(0, len(observations) - 1, FRAMES).astype(int)
            for axes, number in zip(row, pictures, strict=True):
                picture(axes, name, observations[number])
                step = min(number * entry["every"], entry["steps"])
                axes.set_title(f"step {step}", fontsize=8, fontweight="normal")
            row[0].set_title(f"{name}\nstep 0", fontsize=8)
        plotting.figure_title(figure, "Agents trained in a bandit, in its environment")
    return figure


EXPERIMENT = Experiment(
    name="visualize",
    title="Agents trained in a bandit, acting in the environment",
    paper="figure 1, what its agents do",
    claim="agents trained for 10 000 steps in a bandit do well in the environment, which they have never seen.",
    presets={
        "quick": {
            "agents": 4,
            "episodes": 20,
            "brax_episodes": 4,
            "brax_steps": 300,
            "every": 2,
            "seed": 50_000,
        },
        "paper": {
            "agents": 20,
            "episodes": 50,
            "brax_episodes": 10,
            "brax_steps": 1000,
            "every": 2,
            "seed": 50_000,
        },
    },
    minutes={"quick": "2", "paper": "3"},
    needs="needs a browser with access to the web for Hopper's page",
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    extras=animate,
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
