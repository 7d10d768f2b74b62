"""What agents of every algorithm earn after training in the bandits: the zoo's beside the published ones.

    python -m experiments.zoo_table --published DIRECTORY

For every bandit and every algorithm of the paper that fits its actions, agents with hyperparameters
drawn from the paper's lists (in Brax: its fixed ones) train for 10 000 steps in the bandit and are
evaluated in the environment itself, the same agents with sampled and with their most likely actions.
Both bandits of an environment meet the same seeds, so their differences are paired. DIRECTORY holds
the bandits that the paper's authors released, as arrays; without it only the zoo's are measured.

The JSON is written after every (bandit, algorithm), and what it holds already is not measured again:
the same command continues an interrupted one. The table and the figure are made from it;
`--only-render` does nothing but that.
"""

import argparse
import hashlib
import json
import math
import sys
import textwrap
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.page import exit_status
from lpo.cli import configure_jax

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scb.environments.synthetic import SyntheticBandit

ACTIONS = {"mode_actions": "most likely actions", "sampled_actions": "sampled actions"}
BANDITS = ("ours", "published")
DEFAULT_PUBLISHED = Path("../shared/published_scbs")

# Classic control, then Brax by cost. An environment that isn't here comes after these.
ENVIRONMENTS = (
    "CartPole-v1",
    "Acrobot-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
    "hopper",
    "walker2d",
    "swimmer",
    "halfcheetah",
    "humanoidstandup",
)
ALGORITHMS = ("ppo", "sac", "dqn", "ddpg", "td3")

# The return that a bandit of this project is meant to train agents to.
TARGETS = {
    "CartPole-v1": 500.0,
    "Acrobot-v1": -82.0,
    "MountainCar-v0": -130.0,
    "MountainCarContinuous-v0": 92.0,
    "Pendulum-v1": -170.0,
}

# Liesen et al. (2024): returns of agents trained in the published bandits, as the paper states them
# (IQM of 20 agents, 50 episodes; classic control's table, and the columns SCB of Brax's).
PAPER: dict[str, dict[str, float]] = {
    "CartPole-v1": {"ppo": 500.0, "sac": 500.0, "dqn": 500.0},
    "Acrobot-v1": {"ppo": -84.1, "sac": -85.3, "dqn": -82.6},
    "MountainCar-v0": {"ppo": -181.8, "sac": -170.1, "dqn": -118.4},
    "MountainCarContinuous-v0": {"ppo": 66.9, "sac": 91.1, "ddpg": 97.6, "td3": 97.5},
    "Pendulum-v1": {"ppo": -205.4, "sac": -188.3, "ddpg": -164.3, "td3": -168.5},
    "hopper": {"ppo": 853.5, "sac": 2738.8, "ddpg": 3012.4, "td3": 2985.3},
    "walker2d": {"ppo": 858.3, "sac": 1323.1, "ddpg": 1304.3, "td3": 1321.8},
    "swimmer": {"ppo": 348.5, "sac": 361.6, "ddpg": 365.1, "td3": 365.4},
    "halfcheetah": {"ppo": 1657.4, "sac": 5810.4, "ddpg": 6162.4, "td3": 6555.8},
    "humanoidstandup": {"ppo": 13356.1, "sac": 21105.2, "ddpg": 21039.0, "td3": 20372.0},
}
# The same paper: SAC trained on the environment itself (classic control: its table of SAC experts;
# Brax: SAC's column EE).
PAPER_EXPERT = {
    "CartPole-v1": 500.0,
    "Acrobot-v1": -76.7,
    "MountainCar-v0": -117.7,
    "MountainCarContinuous-v0": 94.9,
    "Pendulum-v1": -137.4,
    "hopper": 3119.4,
    "walker2d": 4140.1,
    "swimmer": 124.8,
    "halfcheetah": 7735.5,
    "humanoidstandup": 23808.1,
}


@dataclass(frozen=True)
class Candidate:
    """A bandit to measure.

    Attributes:
      environment: the evaluation environment.
      kind: of `BANDITS`.
      bandit: with its weights.
      sha256: of our bandit's file, or of a published one's arrays.
    """

    environment: str
    kind: str
    bandit: "SyntheticBandit"
    sha256: str


@dataclass(frozen=True)
class Protocol:
    """How bandits are measured; `episodes` are classic control's, the others' are `brax_episodes`."""

    agents: int = 20
    episodes: int = 50
    brax_episodes: int = 5
    backend: str = "generalized"

    def __post_init__(self) -> None:
        from scb.errors import UserError

        for name in ("agents", "episodes", "brax_episodes"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} is {getattr(self, name)}: it must be at least 1.")


def candidates(
    names: Sequence[str] | None, published: Path | None, skip_brax: bool = False
) -> list[Candidate]:
    """The bandits to measure: classic control, hopper, the rest of Brax; ours before the published one.

    Args:
      names: zoo names or files of bandits; None for the whole zoo and all published ones. Where names
        are given, only their environments' published bandits are measured.
      published: folder of the published bandits' arrays.
      skip_brax: leave Brax's environments out.

    Raises:
      UserError: an unknown name, or nothing to measure.
    """
    from scb.environments.brax import BRAX_NAMES
    from scb.environments.zoo import bandit_metadata, home_of, open_bandit, zoo_names
    from scb.errors import UserError
    from scb.importer import PUBLISHED_BANDITS, published_bandit

    paths = {}
    if published is not None:
        stored = {
            environment: published / f"{n}.npz" for n, environment in PUBLISHED_BANDITS.items()
        }
        paths = {environment: path for environment, path in stored.items() if path.is_file()}
        if not paths:
            raise UserError(f"{published} holds no published bandit such as pendulum.npz.")
    found = []
    wanted = set()
    for name in zoo_names() if names is None else names:
        home = home_of(name)
        if home is not None:
            wanted.add(home)
        if home in paths and not name.endswith(".npz") and name not in zoo_names():
            continue  # only the published bandit of that environment can be meant
        bandit = open_bandit(name)
        environment = bandit_metadata(name)["config"].get("evaluation_environment") or home
        if environment is None:
            raise UserError(f"{name} does not say its evaluation environment: name another bandit.")
        wanted.add(environment)
        found.append(Candidate(environment, "ours", bandit, bandit_metadata(name)["sha256"]))
    found += [
        Candidate(environment, "published", published_bandit(path), arrays_digest(path))
        for environment, path in paths.items()
        if names is None or environment in wanted
    ]
    found = [x for x in found if not (skip_brax and x.environment in BRAX_NAMES)]
    if not found:
        raise UserError("there is no bandit to measure: name some, or give --published.")
    return sorted(found, key=lambda x: (_environment_rank(x.environment), BANDITS.index(x.kind)))


def arrays_digest(path: Path) -> str:
    """SHA-256 of an .npz's arrays; packing them anew does not change it."""
    digest = hashlib.sha256()
    with np.load(path, allow_pickle=False) as arrays:
        for name in sorted(arrays.files):
            array = arrays[name]
            digest.update(f"{name}:{array.dtype}:{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def measure(
    found: Iterable[Candidate], protocol: Protocol, report: dict[str, Any], out: Path
) -> None:
    """Fills `report["entries"]` with every algorithm's returns in every bandit, writing it after each.

    An entry that is there already, of the same bandit under the same protocol, stays as it is.
    """
    from scb.agents.hyperparameters import algorithms_for, inner_loop
    from scb.commands import FIRST_REPORTING_SEED
    from scb.discovery import SyntheticTraining, check_fits, judge
    from scb.environments.brax import BRAX_NAMES
    from scb.environments.registry import make
    from scb.environments.synthetic import BanditConfig
    from scb.runs import write_json

    out.parent.mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = report.setdefault("entries", [])
    environment = ""
    # One compiled program for all bandits of an environment that differ in their weights only.
    trainings: dict[tuple[BanditConfig, str], SyntheticTraining] = {}
    for candidate in found:
        brax = candidate.environment in BRAX_NAMES
        if candidate.environment != environment:
            environment, trainings = candidate.environment, {}
            env, env_params = make(environment, **({"backend": protocol.backend} if brax else {}))
        check_fits(candidate.bandit, env, env_params, environment)
        space = env.action_space(env_params)
        for algorithm in algorithms_for(space):
            inner = inner_loop(algorithm, environment, space)
            row: dict[str, Any] = {
                "environment": environment,
                "algorithm": algorithm,
                "bandit": candidate.kind,
                "sha256": candidate.sha256,
                "agents": protocol.agents,
                "episodes": protocol.brax_episodes if brax else protocol.episodes,
                "seed": FIRST_REPORTING_SEED,
                "backend": protocol.backend if brax else None,
                "training_steps": inner.steps,
                "inner_loop": repr(inner),
            }
            if any(row.items() <= _comparable(entry).items() for entry in entries):
                continue
            key = (candidate.bandit.config, algorithm)
            if key not in trainings:
                trainings[key] = SyntheticTraining(candidate.bandit, env, env_params, inner)
            start = time.perf_counter()
            returns = judge(
                trainings[key],
                candidate.bandit.default_params.weights,
                FIRST_REPORTING_SEED,
                row["agents"],
                row["episodes"],
            )
            row["activation"] = candidate.bandit.config.activation
            row["seconds"] = round(time.perf_counter() - start, 1)
            row |= {actions: summary(x) for actions, x in returns.items()}
            entries[:] = [entry for entry in entries if _place(entry) != _place(row)] + [row]
            entries.sort(key=_place)
            report["differences"] = differences(entries)
            write_json(out, report)
            both = ", ".join(f"{ACTIONS[a]} {_cell(row[a]['iqm'])}" for a in returns)
            print(f"{environment} | {candidate.kind} | {algorithm} | {both}", flush=True)
    report["differences"] = differences(entries)
    write_json(out, report)


def _comparable(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in entry.items() if not isinstance(v, dict)}


def summary(returns: np.ndarray) -> dict[str, Any]:
    """{"iqm", "failed", "agents"} of [N] returns; one that is not finite is None, and counts as the worst."""
    from scb.statistics import estimate

    agents = [round(float(r), 3) if np.isfinite(r) else None for r in returns]
    finite = [r for r in agents if r is not None]
    iqm = estimate(_counted(agents)).as_dict() if finite else None
    return {"iqm": iqm, "failed": len(agents) - len(finite), "agents": agents}


def _counted(agents: Sequence[float | None]) -> list[float]:
    worst = min(r for r in agents if r is not None)
    return [worst if r is None else r for r in agents]


def differences(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Ours - published, by environment and algorithm, where both were measured under one protocol."""
    from scb.statistics import paired_difference

    protocol = ("agents", "episodes", "seed", "backend", "inner_loop")
    rows = []
    for (name, algorithm), pair in _pairs(entries).items():
        if len(pair) < 2 or any(pair["ours"].get(x) != pair["published"].get(x) for x in protocol):
            continue
        row: dict[str, Any] = {"environment": name, "algorithm": algorithm}
        for actions in ACTIONS:
            both = [pair[kind][actions] for kind in BANDITS]
            if all(x["iqm"] is not None for x in both):
                ours, theirs = (_counted(x["agents"]) for x in both)
                row[actions] = paired_difference(ours, theirs).as_dict()
        rows.append(row)
    return rows


def _pairs(
    entries: Sequence[Mapping[str, Any]],
) -> dict[tuple[str, str], dict[str, Mapping[str, Any]]]:
    """{(label, algorithm): {"ours": entry, "published": entry}}, in the table's order."""
    pairs: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for entry in sorted(entries, key=_place):
        pairs.setdefault((label(entry), entry["algorithm"]), {})[entry["bandit"]] = entry
    return pairs


def label(entry: Mapping[str, Any]) -> str:
    """The environment, and for Brax its physics: one bandit can be measured in several."""
    physics = entry.get("backend")
    return f"{entry['environment']} ({physics})" if physics else entry["environment"]


def _environment_rank(name: str) -> tuple[int, str]:
    return (ENVIRONMENTS.index(name) if name in ENVIRONMENTS else len(ENVIRONMENTS), name)


def _place(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    return (
        _environment_rank(entry["environment"]),
        entry["backend"] or "",
        BANDITS.index(entry["bandit"]),
        ALGORITHMS.index(entry["algorithm"]),
    )


def markdown(report: Mapping[str, Any]) -> str:
    """The page with the table, the differences and the figure."""
    entries = report["entries"]
    kinds = {entry["bandit"] for entry in entries}
    lines = [
        "# The bandits, by environment and algorithm",
        "",
        *(f"`{command}`\n" for command in report["commands"]),
        *textwrap.wrap(
            f"{_protocol_text(entries)} Interquartile means with 95 % bootstrap intervals over agents.",
            width=118,
        ),
        "",
        "*Ours* are the bandits of this repository"
        + (
            ", *published* those that Liesen et al. (2024) released, measured here with the same"
            if "published" in kinds
            else "."
        ),
        *(["agents on the same seeds."] if "published" in kinds else []),
        "*Paper* is the figure that Liesen et al. (2024) state for theirs, with their own agents. *Target* is the",
        "return aimed at, and whether ours reaches it with the most likely actions / with sampled ones.",
        *(
            [
                "The released bandits of Brax were found on *generalized* physics: in another, their rows say how they",
                "carry over, not what they are worth at home.",
            ]
            if any(
                entry["bandit"] == "published" and entry["backend"] not in (None, "generalized")
                for entry in entries
            )
            else []
        ),
        "",
        "| environment | algorithm | ours, most likely actions | ours, sampled | published, most likely actions "
        "| published, sampled | paper | target |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (name, algorithm), pair in _pairs(entries).items():
        entry = next(iter(pair.values()))
        environment = entry["environment"]
        cells = [
            _cell(pair[kind][actions]["iqm"]) if kind in pair else ""
            for kind in BANDITS
            for actions in ACTIONS
        ]
        paper = PAPER.get(environment, {}).get(algorithm)
        if entry["backend"] not in (None, "generalized"):
            paper = None  # theirs are of the generalized physics
        target = _target_cell(environment, pair.get("ours"))
        cells += ["" if paper is None else _number(paper), target]
        lines.append(f"| {name} | {algorithm.upper()} | {' | '.join(cells)} |")
    failed = [
        f"{entry['algorithm'].upper()} on {label(entry)} ({entry['bandit']}, {ACTIONS[actions]}): "
        f"{entry[actions]['failed']} of {entry['agents']}"
        for entry in entries
        for actions in ACTIONS
        if entry[actions]["failed"]
    ]
    if failed:
        lines += ["", "Agents without a finite return, which count as the worst one: "]
        lines[-1] += "; ".join(failed) + "."
    if report.get("differences"):
        lines += [
            "",
            "## Ours − published, paired by seed",
            "",
            "| environment | algorithm | most likely actions | sampled actions |",
            "| --- | --- | --- | --- |",
        ]
        for row in report["differences"]:
            cells = [_cell(row.get(actions), signed=True) for actions in ACTIONS]
            lines.append(
                f"| {row['environment']} | {row['algorithm'].upper()} | {' | '.join(cells)} |"
            )
    lines += [
        "",
        "![Returns in the environment of agents trained in the bandits](figures/zoo_table.png)",
        "",
        "The dotted lines are the return that Liesen et al. (2024) state for SAC trained on the environment itself.",
        "",
        f"Measured on {report['machine']['cores']} cores of {_processor(report['machine'])}. "
        "Versions and every agent's return: [data/zoo_table.json](data/zoo_table.json).",
        "",
    ]
    return "\n".join(lines)


def _processor(machine: Mapping[str, Any]) -> str:
    name = machine["processor"]
    return f"an {name}" if name[:1] in "AEIO" else f"a {name}"


def _protocol_text(entries: Sequence[Mapping[str, Any]]) -> str:
    """The protocol as the entries have it, in one sentence or two."""

    def values(field: str, among: Iterable[Mapping[str, Any]]) -> str:
        return " or ".join(f"{x:,}".replace(",", " ") for x in sorted({e[field] for e in among}))

    brax = [entry for entry in entries if entry["backend"] is not None]
    classic = [entry for entry in entries if entry["backend"] is None]
    text = (
        f"{values('agents', entries)} agents, trained for {values('training_steps', entries)} steps in the bandit; "
        f"reporting seed {values('seed', entries)}."
    )
    if classic:
        text += (
            " Classic control: hyperparameters drawn from the paper's lists, "
            f"{values('episodes', classic)} episodes an agent."
        )
    if brax:
        physics = " or ".join(sorted({entry["backend"] for entry in brax}))
        text += (
            f" Brax ({physics} physics): the paper's fixed hyperparameters, "
            f"{values('episodes', brax)} episodes an agent."
        )
    return text


def _cell(interval: Mapping[str, Any] | None, signed: bool = False) -> str:
    """An estimate as the documentation writes it: −194.2 [−262.8, −167.9]."""
    from scb.statistics import Estimate

    if interval is None:
        return "none"
    text = str(Estimate(**interval)).rsplit(" (n=", 1)[0].replace("-", "−")
    return f"+{text}" if signed and interval["value"] > 0 else text


def _number(x: float) -> str:
    return f"{x:g}".replace("-", "−")


def reached(environment: str, entry: Mapping[str, Any]) -> dict[str, bool]:
    """{actions: whether the interquartile mean is at the environment's target or above}."""
    iqms = {actions: entry[actions]["iqm"] for actions in ACTIONS}
    return {
        actions: iqm is not None and iqm["value"] >= TARGETS[environment]
        for actions, iqm in iqms.items()
    }


def _target_cell(environment: str, ours: Mapping[str, Any] | None) -> str:
    if environment not in TARGETS:
        return ""
    target = _number(TARGETS[environment])
    if ours is None:
        return target
    answers = ["yes" if answer else "no" for answer in reached(environment, ours).values()]
    return f"{target}: {' / '.join(answers)}"


def figure(report: Mapping[str, Any]) -> "Figure":
    """One panel an environment: every algorithm's interquartile mean and interval, ours and published."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    from scb import plotting
    from scb.errors import UserError

    entries = report["entries"]
    if not entries:
        raise UserError("nothing has been measured yet: there is no figure to draw.")
    pairs = _pairs(entries)
    environments = list(dict.fromkeys(environment for environment, _ in pairs))
    looks = {"ours": (plotting.VERMILLION, "o"), "published": (plotting.BLUE, "s")}
    offsets = {
        (kind, actions): offset
        for (kind, actions), offset in zip(
            [(kind, actions) for kind in BANDITS for actions in ACTIONS],
            (-0.3, -0.1, 0.1, 0.3),
            strict=True,
        )
    }
    columns = min(2, len(environments))
    rows = math.ceil(len(environments) / columns)
    with plotting.figure_style():
        drawn = Figure(figsize=(plotting.WIDTH, 2.1 * rows + 1.1))
        grid = drawn.subplots(rows, columns, squeeze=False).flat
        for panel, (axes, environment) in enumerate(zip(grid, environments, strict=False)):
            algorithms = [a for e, a in pairs if e == environment]
            for position, algorithm in enumerate(algorithms):
                if position % 2 == 0:
                    axes.axhspan(position - 0.5, position + 0.5, color="#F4F4F4", linewidth=0)
                for (kind, actions), offset in offsets.items():
                    entry = pairs[environment, algorithm].get(kind)
                    if entry is None or entry[actions]["iqm"] is None:
                        continue
                    iqm, (color, marker) = entry[actions]["iqm"], looks[kind]
                    y = position + offset
                    if iqm["low"] is not None and iqm["high"] is not None:
                        axes.hlines(y, iqm["low"], iqm["high"], color=color, linewidth=1.6)
                    axes.plot(
                        iqm["value"],
                        y,
                        color=color,
                        marker=marker,
                        markerfacecolor=color if actions == "mode_actions" else "white",
                        markeredgewidth=1.4,
                        markersize=6,
                        linestyle="",
                    )
            expert = _paper_expert(environment)
            if expert is not None:
                axes.axvline(expert, color=plotting.BLACK, linewidth=1.4, linestyle=":")
            axes.set_yticks(range(len(algorithms)), [a.upper() for a in algorithms])
            axes.set_ylim(len(algorithms) - 0.5, -0.5)
            axes.tick_params(axis="y", length=0)
            axes.grid(axis="y", visible=False)
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
            axes.margins(x=0.06)
            axes.set_title(_panel_title(environment, entries))
            if panel + columns >= len(environments):  # nothing below it
                axes.set_xlabel("return in the environment")
        for axes in drawn.axes[len(environments) :]:
            axes.remove()
        kinds = [kind for kind in BANDITS if any(e["bandit"] == kind for e in entries)]
        handles = [
            Line2D(
                [],
                [],
                color=looks[kind][0],
                marker=looks[kind][1],
                markerfacecolor=looks[kind][0] if actions == "mode_actions" else "white",
                markeredgewidth=1.4,
                linewidth=1.6,
            )
            for kind in kinds
            for actions in ACTIONS
        ]
        names = [f"{kind}, {text}" for kind in kinds for text in ACTIONS.values()]
        if any(_paper_expert(environment) is not None for environment in environments):
            handles.append(Line2D([], [], color=plotting.BLACK, linewidth=1.4, linestyle=":"))
            names.append("SAC trained on the environment (paper)")
        agents = " or ".join(str(n) for n in sorted({entry["agents"] for entry in entries}))
        plotting.figure_title(
            drawn,
            f"Agents trained in a bandit, in its environment: IQM of {agents} agents, 95 % intervals",
        )
        plotting.legend_below(drawn, (handles, names), columns=3)
    return drawn


def _paper_expert(name: str) -> float | None:
    """By label; the paper's Brax has the generalized physics."""
    return PAPER_EXPERT.get(name.removesuffix(" (generalized)"))


def _panel_title(environment: str, entries: Sequence[Mapping[str, Any]]) -> str:
    of_it = [entry for entry in entries if label(entry) == environment]
    if of_it[0]["backend"] is None:
        return environment
    episodes = " or ".join(str(n) for n in sorted({entry["episodes"] for entry in of_it}))
    return f"{environment.removesuffix(')')}, {episodes} episodes)"


def render(report: Mapping[str, Any], docs: Path) -> None:
    """Writes docs/zoo_table.md and docs/figures/zoo_table.png."""
    from scb import plotting

    docs.mkdir(parents=True, exist_ok=True)
    (docs / "zoo_table.md").write_text(markdown(report))
    plotting.save(figure(report), docs / "figures" / "zoo_table.png")


def command_text(arguments: argparse.Namespace, published: bool) -> str:
    """The command, with no path of this machine in it."""
    parts = ["python -m experiments.zoo_table"]
    if published:
        parts.append("--published DIRECTORY")
    if arguments.bandits:
        parts.append(f"--bandits {' '.join(Path(name).name for name in arguments.bandits)}")
    parts.append(f"--agents {arguments.agents} --episodes {arguments.episodes}")
    if arguments.skip_brax:
        parts.append("--skip-brax")
    else:
        parts.append(f"--brax-episodes {arguments.brax_episodes} --backend {arguments.backend}")
    return " ".join(parts)


def read_report(path: Path) -> dict[str, Any]:
    """A report from its file; a UserError where there is none."""
    from scb.errors import UserError

    try:
        return dict(json.loads(path.read_text()))
    except (OSError, TypeError, ValueError) as error:
        raise UserError(f"{path} is no report of this command ({error}): measure first.") from error


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument(
        "--published", type=Path, help="folder with the published bandits' .npz files"
    )
    made.add_argument(
        "--bandits", nargs="+", help="zoo names or path.npz; the zoo and all published if left out"
    )
    made.add_argument("--agents", type=int, default=20)
    made.add_argument("--episodes", type=int, default=50, help="of each agent in classic control")
    made.add_argument("--brax-episodes", type=int, default=5, help="of each agent in Brax")
    made.add_argument("--backend", default="generalized", help="Brax's physics")
    made.add_argument("--skip-brax", action="store_true")
    made.add_argument("--out", type=Path, default=Path("docs/data/zoo_table.json"))
    made.add_argument(
        "--docs", type=Path, default=Path("docs"), help="for the table and the figure"
    )
    made.add_argument("--only-render", action="store_true", help="measure nothing")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    arguments = parser().parse_args(argv)
    configure_jax()

    from scb.artefacts import machine_description, package_versions

    def measure_and_render() -> int:
        if not arguments.only_render:
            published = arguments.published
            if published is None and DEFAULT_PUBLISHED.is_dir():
                published = DEFAULT_PUBLISHED
            report = read_report(arguments.out) if arguments.out.exists() else {}
            entries = report.get("entries", [])
            report = {
                # Entries that are there already stay, so several commands may have made them.
                "commands": list(
                    dict.fromkeys(
                        [
                            *report.get("commands", []),
                            command_text(arguments, published is not None),
                        ]
                    )
                ),
                "versions": package_versions(),
                "machine": machine_description(),
                "targets": TARGETS,
                "differences": [],
                "entries": entries,
            }
            protocol = Protocol(
                arguments.agents, arguments.episodes, arguments.brax_episodes, arguments.backend
            )
            found = candidates(arguments.bandits, published, arguments.skip_brax)
            measure(found, protocol, report, arguments.out)
        render(read_report(arguments.out), arguments.docs)
        return 0

    return exit_status("zoo_table", measure_and_render)


if __name__ == "__main__":
    sys.exit(main())
