"""What makes an objective carry over from a bandit: every lever of the meta-training, one at a time.

    python -m experiments transfer_study

Each variation changes one setting of `lpo meta-train`, learns an objective with it, and trains PPO
with what it learned: on Pendulum, with Flax's initialisation of the policy and with a small last layer,
and in the rest of classic control. Searches are run folders under --runs and are resumed; what --out
holds already is not measured again, so the same command continues an interrupted study.
`--variations` names some of them, and `--meta-seeds` further searches of these; `--only-render` makes
page and figure from --out.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.claims import ENOUGH, FAILS, HOLDS, Claim, confidence, judge, of_searches
from experiments.harness import Experiment, plan_of
from experiments.parts import InParts, Keys, Part
from experiments.reports import Report, settled
from experiments.searches import meta_training, objective_of_run
from lpo.comparison import compare, ppo_spec
from lpo.objectives import Objective, load_objective
from lpo.suite import suite
from scb.environments.registry import environment_spec
from scb.errors import one_of
from scb.measurement import check_seeds
from scb.plotting import BLUE, GREY, VERMILLION, estimate_row, name_rows
from scb.rows import Rows
from scb.seeds import REPORTING
from scb.statistics import Estimate, estimate, pooled_estimate

_PLAN = plan_of("transfer_study")
VARIATIONS: dict[str, dict[str, Any]] = _PLAN["variations"]
REFERENCES: list[str] = _PLAN["references"]
NO_SEARCH = "no search"  # stands for the meta-seed of a reference


@dataclass(frozen=True)
class Evaluation:
    """Where objectives are judged, on reporting seeds of their own, apart from those of other tables."""

    name: str
    environments: tuple[str, ...]
    policy_output_scale: float = 1.0
    seeds: int = 20
    first_seed: int = REPORTING[11_000]

    @property
    def normalized(self) -> bool:
        """Returns of several environments have scales of their own."""
        return len(self.environments) > 1


PENDULUM = "Pendulum-v1"
EVALUATIONS = (
    Evaluation("Pendulum", (PENDULUM,)),
    Evaluation("Pendulum, small last layer", (PENDULUM,), policy_output_scale=0.01),
    Evaluation(
        "classic control without it",
        tuple(name for name in suite("classic") if name != PENDULUM),
        seeds=10,
    ),
)


def settings_of(
    variation: str, seed: int, generations: int, population_size: int
) -> dict[str, Any]:
    """The flags of `lpo meta-train` for a variation."""
    return {
        "seed": seed,
        "population_size": population_size,
        "generations": generations,
        **VARIATIONS[variation],
    }


def difference(
    report: Report, name: str, evaluation: str
) -> Callable[..., Estimate] | Estimate | None:
    """How far an objective ends above the default's: as evidence of a claim, with searches and agents resampled.

    A variation is compared over the searches of one seed in both; of too few there is no interval. A
    reference was searched for by nobody, so its one set of agents stands against all searches of the default.
    """
    default = report["objectives"].get("default", {}).get("returns", {}).get(evaluation, {})
    own = report["objectives"][name]["returns"].get(evaluation, {})
    reference = name in REFERENCES
    seeds = [seed for seed in default if reference or seed in own]
    if not seeds or not own or name == "default":
        return None
    first = list(own.values()) if reference else [own[seed] for seed in seeds]
    second = [default[seed] for seed in seeds]
    return of_searches(first, second, paired=not reference)


def claims(report: Report) -> list[Claim]:
    """Of every objective and evaluation: above the default."""
    return [
        Claim(f"{name}, {e['name']}", difference(report, name, e["name"]), of=(name, e["name"]))
        for name in report["objectives"]
        for e in report["evaluations"]
    ]


def summary(report: Report) -> list[dict[str, Any]]:
    """One row an objective: per evaluation the estimate over searches and agents, and the difference to the default's.

    Intervals of the differences are corrected for their number.
    """
    found = {x.claim.of: x for x in judge(claims(report))}
    rows = []
    for name, entry in report["objectives"].items():
        row: dict[str, Any] = {
            "name": name,
            "seconds": entry.get("seconds"),
            "in": {},
            "against": {},
        }
        for evaluation, returns in entry["returns"].items():
            # The evaluations that came later have not all of the searches.
            searches = 0 if name in REFERENCES else len(returns)
            row["searches"] = max(row.get("searches", 0), searches)
            row["in"][evaluation] = pooled_estimate(list(returns.values()))
            if (estimate := found[name, evaluation].estimate) is not None:
                row["against"][evaluation] = (estimate, found[name, evaluation].outcome)
        rows.append(row)
    return rows


def facts(report: Report) -> dict[str, Any]:
    """The rows, and by place which objectives enough searches show to be better or worse than the default's."""
    rows = summary(report)
    places = {e["name"]: 2 if Evaluation(**e).normalized else 0 for e in report["evaluations"]}

    def those(outcome: str, of: Callable[[str], bool] = lambda name: True) -> dict[str, list[str]]:
        found = {
            place: [
                row["name"]
                for row in rows
                if row["against"].get(place, (None, None))[1] == outcome and of(row["name"])
            ]
            for place in places
        }
        return {place: names for place, names in found.items() if names}

    number = sum(x.low is not None for row in rows for x, _ in row["against"].values())
    return {
        "rows": rows,
        "better": those(HOLDS),
        "worse": those(FAILS),
        "behind": those(FAILS, lambda name: name not in REFERENCES),
        "enough": ENOUGH,
        "number": number,
        "places": places,
        "level": confidence(claims(report)),
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """One panel an evaluation, one line an objective: interquartile mean with its interval, each agent a dot."""
    objectives = report["objectives"]
    figure = Figure(figsize=(11.0, 1.6 + 0.32 * len(objectives)))
    panels = figure.subplots(1, len(report["evaluations"]), sharey=True, squeeze=False)[0]
    for axes, at in zip(panels, report["evaluations"], strict=True):
        evaluation = at["name"]
        for position, (name, entry) in enumerate(objectives.items()):
            if evaluation not in entry["returns"]:
                continue
            color = BLUE if name in REFERENCES else VERMILLION if name == "default" else GREY
            returns = list(entry["returns"][evaluation].values())
            estimate_row(axes, position, np.concatenate(returns), pooled_estimate(returns), color)
        scale = "normalised score" if Evaluation(**at).normalized else "final return"
        axes.set(title=evaluation, xlabel=scale)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    name_rows(panels[0], objectives)
    figure.suptitle("Interquartile mean with its 95 % interval, each agent a dot")
    return figure


@dataclass(frozen=True)
class Options:
    """What is searched for."""

    variations: tuple[str, ...] = tuple(VARIATIONS)
    """some of them"""
    meta_seeds: tuple[int, ...] = (0,)
    """searches of each"""
    generations: int = 30
    population_size: int = 32
    runs: Path = Path("runs/transfer_study")
    """for the run folders"""

    def __post_init__(self) -> None:
        check_seeds(self.meta_seeds)
        for name in self.variations:
            one_of("variation", name, VARIATIONS)


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """Objectives: each is learned, then judged where it is not yet; all have as many searches wherever it ends."""
    searches = {"generations": options.generations, "population_size": options.population_size}
    settled(report, searches=searches)
    report["evaluations"] = [asdict(e) for e in EVALUATIONS]
    seeds = [str(seed) for seed in options.meta_seeds]
    for name, seed in (
        *((name, NO_SEARCH) for name in REFERENCES),
        *((name, seed) for seed in seeds for name in options.variations),
    ):
        path = ("objectives", name)
        places: dict[Keys, Evaluation] = {("returns", at.name, seed): at for at in EVALUATIONS}
        digest = report.get("objectives", {}).get(name, {}).get("digests", {}).get(seed)
        yield Part.lacking(report, path, places, partial(_judged, name, seed, digest, options))


measure = InParts(parts)


def _judged(
    name: str, seed: str, digest: str | None, options: Options, left: Sequence[Evaluation]
) -> dict[str, Any]:
    """What an objective earns, and of one that was learned what that took.

    A search of an earlier version may have found another: what the report holds of that is measured again.

    Args:
      left: the evaluations that the report lacks.
      digest: of the objective whose evaluations it has.
    """
    if name in REFERENCES:
        entry: dict[str, Any] = {}
        objective = load_objective(name)
    else:
        objective, entry = _learned(name, int(seed), options)
    same = entry.get("digests", {}).get(seed) == digest
    returns = {}
    for at in left if same else EVALUATIONS:
        each = [_earned(objective, environment, at, options) for environment in at.environments]
        earned = np.mean(each, axis=0)
        returns[at.name] = {seed: np.round(earned, 4 if at.normalized else 2).tolist()}
        print(f"{name} | {at.name} | {seed} | {estimate(earned)}", flush=True)
    return {**entry, "returns": returns}


def _earned(objective: Objective, environment: str, at: Evaluation, options: Options) -> np.ndarray:
    """[seeds] what agents earn at the end of their training: a score where there are other environments too."""
    # What was found by an earlier version is another objective, whose rows are its own.
    digest = f"-{found[:8]}" if (found := objective.sha256) else ""
    (curves,) = compare(
        environment,
        [objective],
        list(range(at.first_seed, at.first_seed + at.seeds)),
        spec=ppo_spec(environment, hyperparameters={"policy_output_scale": at.policy_output_scale}),
        points=1,
        rows=Rows(options.runs / at.name / f"{objective.name}{digest}-{environment}.rows.jsonl"),
    ).curves
    if not at.normalized:
        return curves.final
    return environment_spec(environment).score(curves.final)


def _learned(name: str, seed: int, options: Options) -> tuple[Objective, dict[str, Any]]:
    """A variation's objective of one search, and what that took."""
    settings = settings_of(name, seed, options.generations, options.population_size)
    objective = objective_of_run(settings, options.runs / f"{name.replace(' ', '-')}-{seed}")
    cost = objective.metadata["cost"]
    entry = {
        "command": meta_training({**settings, "seed": 0}).command,
        "seconds": cost["seconds"],
        "digests": {str(seed): objective.sha256},
    }
    return replace(objective, name=f"{name}-{seed}"), entry


EXPERIMENT = Experiment(
    "transfer_study",
    "What makes an objective carry over from a bandit",
    measure,
    facts=facts,
    draw=draw,
    options=Options,
    keys=("searches", "objectives"),
)
