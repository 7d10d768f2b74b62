"""Agents that were trained in a bandit, acting in the environment: classic control as GIFs, Hopper as a page.

    python -m experiments visualize

PPO agents train for 10 000 steps in each bandit of the zoo; the best of them by other episodes is
shown. The GIFs lie beside the page, Brax's viewer (which loads its script from the web) in
runs/visualize.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.claims import UNDECIDED, Claim, judge
from experiments.harness import CLASSIC_CONTROL, Experiment, Save
from experiments.reports import Report, bandit_of
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.analysis import animation
from scb.analysis.animation import picture, save_gif
from scb.analysis.states import follow
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.experts import best_agent
from scb.files import packed, unpacked
from scb.keys import root_key, split_key
from scb.measurement import Judge
from scb.statistics import DECIDING, Estimate, estimate

HOPPER = "hopper"
STANDING = environment_spec(HOPPER).standing["generalized"]
FRAMES = 6  # of the film strip
PICTURES = 125  # of a GIF at most: five seconds
VIEWER = Path("runs/visualize/hopper.html")


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """An environment at a time: train, choose, record."""
    found = report.setdefault("environments", {})
    for name in (*CLASSIC_CONTROL, HOPPER):
        if found.get(name) is None:
            found[name] = _show(name, plan)
            save()
        elif name == HOPPER and not VIEWER.exists():
            _show(name, plan)  # for its page, which no report holds


def _show(name: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    place = environment_spec(name)
    env, env_params = place.make()
    bandit, digest = bandit_of(name)
    spec = bandit_agent("ppo", name, sampled=False)
    agent = spec.agent(bandit)
    key_agents, key_show = split_key(root_key(plan["seed"]))
    judge = Judge(
        env, env_params, plan["brax_episodes" if place.backends else "episodes"], mode=True
    )
    state, returns = best_agent(
        agent, spec, bandit.default_params, key_agents, plan["agents"], judge
    )
    if not np.isfinite(returns).all():
        raise UserError(f"an agent of {name} has no finite return: choose another seed.")

    def policy(observation: Any, key: Any) -> Any:
        return agent.act(state, observation, key, bandit.default_params, mode=True)

    entry: dict[str, Any] = {"sha256": digest, "agents": estimate(returns).as_dict()}
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


def claims(report: Report) -> list[Claim]:
    """Environment by environment: the paper's SAC expert's return or next to it; on Hopper more than standing still."""
    found = []
    for name, entry in report["environments"].items():
        agents = Estimate(**entry["agents"])
        if agents.n < DECIDING:
            agents = agents.without_interval()
        if name == HOPPER:
            found.append(Claim(f"{name}: more than standing still", agents, STANDING, places=0))
            continue
        expert = environment_spec(name).reference_return()
        margin = round(0.1 * abs(expert), 1)
        text = f"{name}: no less than the paper's SAC expert"
        found.append(
            Claim(text, agents, expert, margin, "doing well: a tenth of its return", places=0)
        )
    return found


def facts(report: Report) -> dict[str, Any]:
    """What is shown where."""
    undecided = any(
        HOPPER in x.claim.text and x.outcome == UNDECIDED for x in judge(claims(report))
    )
    return {
        "hopper": HOPPER,
        "viewer": VIEWER,
        "standing": STANDING,
        "hopper_undecided": undecided,
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """A film strip: a row an environment, from the first step to the last."""
    films = {n: e for n, e in report["environments"].items() if "film" in e}
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
    plotting.figure_title(figure, "The best agent trained in each bandit, in its environment")
    return figure


EXPERIMENT = Experiment.of_the_paper(
    "visualize", measure, draw, claims, facts=facts, extras=animate
)
