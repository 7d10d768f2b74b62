"""What agents of every algorithm earn after training in the bandits: the zoo's beside the published ones.

    python -m experiments zoo_table --published DIRECTORY

For every bandit and every algorithm of the paper that fits its actions, agents with hyperparameters
drawn from the paper's lists (in Brax: its fixed ones) train for 10 000 steps in the bandit and are
evaluated in the environment itself, the same agents with sampled and with their most likely actions.
Both bandits of an environment meet the same seeds, so their differences are paired. DIRECTORY holds
the bandits that the paper's authors released, as arrays; without it only the zoo's are measured.

The JSON is written after every (bandit, algorithm), and what it holds already is not measured again:
the same command continues an interrupted one. The table and the figure are made from it;
`--only-render` does nothing but that.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Experiment, Save, command_of
from experiments.rendering import digits
from experiments.zoo_table_page import (
    ACTIONS,
    BANDITS,
    facts,
    figures,
    pairs,
    place,
    rank,
    returns_of,
)
from scb.agents.spec import AgentSpec, algorithms_for, bandit_agent
from scb.artefacts import arrays_digest
from scb.configurations import config_dict
from scb.environments.registry import environment_spec
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import bandit_metadata, load_bandit, zoo_names
from scb.errors import UserError, at_least
from scb.importer import PUBLISHED_BANDITS, published_bandit
from scb.judgement import BRAX_EPISODES, EPISODES, check_fits, judge
from scb.measurement import Place, as_random
from scb.seeds import REPORTING
from scb.statistics import estimate, paired_difference
from scb.stopwatch import Stopwatch


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
    bandit: SyntheticBandit
    sha256: str


@dataclass(frozen=True)
class Options:
    """What is measured, and how."""

    published: Path | None = None
    """folder with the published bandits' .npz files"""
    bandits: tuple[str, ...] = ()
    """zoo names or path.npz; the zoo and all published if left out"""
    agents: int = 20
    episodes: int = EPISODES
    """of each agent in classic control"""
    brax_episodes: int = BRAX_EPISODES
    """of each agent in Brax"""
    backend: str | None = None
    """Brax's physics"""
    skip_brax: bool = False

    def __post_init__(self) -> None:
        at_least(2, self, "agents")  # of one there is no spread
        at_least(1, self, "episodes", "brax_episodes")


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
    paths = {}
    if published is not None:
        stored = {home: published / f"{name}.npz" for name, home in PUBLISHED_BANDITS.items()}
        paths = {environment: path for environment, path in stored.items() if path.is_file()}
        if not paths:
            raise UserError(f"{published} holds no published bandit such as pendulum.npz.")
    homes = {environment_spec(environment).bandit: environment for environment in paths}
    found, wanted = [], set()
    for name in zoo_names() if names is None else names:
        if name in homes and name not in zoo_names():  # published alone
            wanted.add(homes[name])
            continue
        bandit, digest = load_bandit(name), bandit_metadata(name)["sha256"]
        environment = environment_spec(name).evaluation_environment
        wanted.add(environment)
        found.append(Candidate(environment, "ours", bandit, digest))
    found += [
        Candidate(environment, "published", published_bandit(path), _digest(path))
        for environment, path in paths.items()
        if names is None or environment in wanted
    ]
    found = [x for x in found if not (skip_brax and environment_spec(x.environment).backends)]
    if not found:
        raise UserError("there is no bandit to measure: name some, or give --published.")
    return sorted(found, key=lambda x: (rank(x.environment), BANDITS.index(x.kind)))


def bandits(environment: str, published: Path | None) -> dict[str, Candidate]:
    """{kind: the bandit of this environment}, of the kinds that there are."""
    return {x.kind: x for x in candidates((environment_spec(environment).bandit,), published)}


def _digest(path: Path) -> str:
    """Of an .npz's arrays; packing them anew does not change it."""
    with np.load(path, allow_pickle=False) as arrays:
        return arrays_digest(arrays)


def measure_bandits(
    found: Iterable[Candidate], options: Options, report: dict[str, Any], save: Save
) -> None:
    """Fills `report["entries"]` with every algorithm's returns in every bandit, writing it after each.

    An entry that is there already, of the same bandit under the same protocol, stays as it is.
    """
    entries: list[dict[str, Any]] = report.setdefault("entries", [])
    environment = ""
    # One compiled program for all bandits of an environment that differ in their weights only.
    bandits: dict[BanditConfig, SyntheticBandit] = {}
    for candidate in found:
        home = environment_spec(candidate.environment)
        backend = home.physics(options.backend)
        if candidate.environment != environment:
            environment, bandits = candidate.environment, {}
            judge_in = Place.named(environment, backend)
        check_fits(candidate.bandit, judge_in)
        for algorithm in algorithms_for(judge_in.env.action_space(judge_in.params)):
            spec = bandit_agent(algorithm, environment)
            row: dict[str, Any] = {
                "environment": environment,
                "algorithm": algorithm,
                "bandit": candidate.kind,
                "sha256": candidate.sha256,
                "agents": options.agents,
                "episodes": options.brax_episodes if home.backends else options.episodes,
                "seed": REPORTING.start,
                "backend": backend,
                "training_steps": spec.steps,
                "inner_loop": inner_loop(spec),
            }
            if any(row.items() <= _comparable(entry).items() for entry in entries):
                continue
            watch = Stopwatch()
            returns = judge(
                spec,
                bandits.setdefault(candidate.bandit.config, candidate.bandit),
                candidate.bandit.default_params.weights,
                judge_in,
                REPORTING.start,
                row["agents"],
                row["episodes"],
            )
            row["activation"] = candidate.bandit.config.activation
            row["seconds"] = round(watch.lap(), 1)
            row |= {actions: summary(x, judge_in) for actions, x in returns.items()}
            entries[:] = [entry for entry in entries if place(entry) != place(row)] + [row]
            entries.sort(key=place)
            report["differences"] = differences(entries)
            save()
            both = ", ".join(f"{ACTIONS[a]} {digits(row[a]['iqm'])}" for a in returns)
            print(f"{environment} | {candidate.kind} | {algorithm} | {both}", flush=True)
    report["differences"] = differences(entries)
    save()


def inner_loop(spec: AgentSpec) -> str:
    """What agents were trained with, as one line that does not depend on the code's own names for it."""
    parts = {name: config_dict(getattr(spec, name)) for name in ("config", "hyperparameters")}
    return json.dumps({**parts, "lists": dict(spec.lists)}, sort_keys=True)


def _comparable(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in entry.items() if not isinstance(v, dict)}


def summary(returns: np.ndarray, judge_in: Place) -> dict[str, Any]:
    """{"iqm", "failed", "agents"} of [N] returns; one that is not finite is None, and counts as random actions."""
    values, failed = as_random(np.round(np.asarray(returns, float), 3), judge_in)
    agents = [None if bad else value for value, bad in zip(values.tolist(), failed, strict=True)]
    iqm = None if failed.all() else estimate(values).as_dict()
    return {"iqm": iqm, "failed": int(failed.sum()), "agents": agents}


def differences(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Ours - published, by environment and algorithm, where both were measured alike."""
    protocol = ("agents", "episodes", "seed", "backend", "inner_loop")
    rows = []
    for (name, algorithm), pair in pairs(entries).items():
        if len(pair) < 2 or any(pair["ours"].get(x) != pair["published"].get(x) for x in protocol):
            continue
        row: dict[str, Any] = {"environment": name, "algorithm": algorithm}
        for actions in ACTIONS:
            both = [pair[kind] for kind in BANDITS]
            if all(x[actions]["iqm"] is not None for x in both):
                ours, theirs = (returns_of(x, actions) for x in both)
                row[actions] = paired_difference(ours, theirs).as_dict()
        rows.append(row)
    return rows


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """All bandits. Entries that are there already stay, so several commands may have made them."""
    # No path of this machine is in it.
    published = options.published and Path("DIRECTORY")
    names = tuple(Path(name).name for name in options.bandits)
    command = command_of("zoo_table", replace(options, published=published, bandits=names))
    commands = dict.fromkeys([*report.get("commands", []), command])
    report["commands"] = list(commands)
    found = candidates(options.bandits or None, options.published, options.skip_brax)
    measure_bandits(found, options, report, save)


EXPERIMENT = Experiment(
    "zoo_table",
    "The bandits, by environment and algorithm",
    measure,
    facts=facts,
    draw=figures,
    options=Options,
)
