"""What the meta-evolution needs: learned initial states, no transitions, continuous latents, curricula.

    python -m experiments.ablations

Searches from random weights that differ in one thing each: what of the synthetic environment is
learned (T the transition, I the initial state, C with a curriculum), the latent's distribution, the
curriculum's shape. Run folders are under runs/ablations and are resumed.
"""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.page import Experiment, Save, table, text
from experiments.page import main as run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scb.discovery import DiscoveryConfig
    from scb.statistics import Estimate

ENVIRONMENTS = ("Pendulum-v1", "MountainCar-v0")
# The paper finds no curriculum for Pendulum.
WITH_CURRICULUM = ("MountainCar-v0",)
WORST = {"MountainCar-v0": -200.0}  # what an agent earns that never reaches the goal
NONE = "none"
LATENTS = {
    "normal": "normal",
    "uniform": "uniform",
    "categorical": "categorical, equal",
    "softmax_categorical": "categorical, softmax",
}
SHAPES = ("linear", "quadratic", "cosine", "exponential", "step")


def name_of(parameterization: str, latent: str, curriculum: str) -> str:
    """The name of a search in the report."""
    return f"{parameterization} | {latent} | {curriculum}"


def rows(environment: str) -> dict[str, dict[str, str]]:
    """{row of the figure: {label: search}}; a search may stand in several rows."""
    best = "linear" if environment in WITH_CURRICULUM else NONE
    learned = {x: name_of(x, "normal", NONE) for x in ("T", "TI", "I")}
    found = {"what is learned": learned}
    if environment in WITH_CURRICULUM:
        learned["IC"] = name_of("I", "normal", "linear")
    found["latent"] = {label: name_of("I", x, best) for x, label in LATENTS.items()}
    if environment in WITH_CURRICULUM:
        found["curriculum"] = {x: name_of("I", "normal", x) for x in (NONE, *SHAPES)}
    return found


def searches(environment: str) -> list[str]:
    """Every search of an environment once."""
    return list(dict.fromkeys(s for row in rows(environment).values() for s in row.values()))


def config_of(
    environment: str, search: str, seed: int, plan: Mapping[str, Any]
) -> "DiscoveryConfig":
    """The search's configuration: the paper's recipe, at the plan's size."""
    from dataclasses import replace

    from scb.curriculum import paper_curriculum
    from scb.discovery import DiscoveryConfig
    from scb.environments.synthetic import BanditConfig
    from scb.evolution import EvolutionConfig

    parameterization, latent, shape = search.split(" | ")
    own = plan["environments"][environment]
    curriculum = None
    if shape != NONE:
        curriculum = paper_curriculum(environment, own["generations"])
        assert curriculum is not None
        curriculum = replace(curriculum, shape=shape)
    return DiscoveryConfig(
        environment,
        parameterization=parameterization,
        bandit=BanditConfig(latent=latent),
        algorithms=tuple(plan["algorithms"]),
        agents_per_candidate=own["agents_per_candidate"],
        evaluation_episodes=plan["episodes"],
        curriculum=curriculum,
        init="random",
        evolution=EvolutionConfig(
            strategy="SNES",
            population_size=own["population_size"],
            num_generations=own["generations"],
            sigma=0.05,
            mean_evaluations=plan["mean_evaluations"],
            evaluate_mean_every=plan["evaluate_mean_every"],
            seed=seed,
        ),
    )


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A search at a time, seeds outermost, so that an interrupted run has all lines."""
    from experiments.searches import curve, search

    report["plan"] = dict(plan)
    found = report.setdefault("environments", {name: {} for name in ENVIRONMENTS})
    for seed in range(max(x["seeds"] for x in plan["environments"].values())):
        for environment in ENVIRONMENTS:
            for name in searches(environment):
                curves = found[environment].setdefault(name, {})
                if str(seed) in curves or seed >= plan["environments"][environment]["seeds"]:
                    continue
                folder = f"{plan['runs']}/{environment}/{name.replace(' | ', '-')}-{seed}"
                _, outcome = search(config_of(environment, name, seed, plan), folder)
                curves[str(seed)] = {**curve(outcome.metrics), "seconds": round(outcome.seconds, 1)}
                save()


def finals(report: Mapping[str, Any], environment: str, search: str) -> "Estimate | None":
    """The last judgement of the searches' means, over seeds; None where every one failed."""
    from scb.statistics import estimate

    curves = report["environments"][environment].get(search, {}).values()
    last = [c["fitness"][-1] for c in curves]
    known = [x for x in last if x is not None]
    return estimate(known) if known else None


def _worst_failing(report: Mapping[str, Any], environment: str, search: str) -> float:
    curves = report["environments"][environment].get(search, {}).values()
    return max((max(c["failed"]) for c in curves), default=0.0)


def verdict(report: Mapping[str, Any]) -> str:
    """The paper's claims in its order, each with its figures."""
    parts = []
    for environment in ENVIRONMENTS:
        described = {
            row: ", ".join(
                f"{label} {text(found, 0) if found else 'all failed'}"
                for label, search in labels.items()
                for found in [finals(report, environment, search)]
            )
            for row, labels in rows(environment).items()
        }
        t, ti, i = (
            finals(report, environment, name_of(x, "normal", NONE)) for x in ("T", "TI", "I")
        )
        said = [f"{environment}: {described['what is learned']}"]
        if t is not None and i is not None:
            better = i.value > t.value and (ti is None or ti.value >= t.value)
            said.append(
                "learned initial states are better than the environment's"
                if better
                else "learned initial states are not better in all of them"
            )
        if environment in WORST and t is not None and t.value <= WORST[environment]:
            said.append("T never reaches the goal, as in the paper")
        latents = {
            x: finals(report, environment, s) for x, s in rows(environment)["latent"].items()
        }
        known = {x: f.value for x, f in latents.items() if f is not None}
        continuous = [v for x, v in known.items() if "categorical" not in x]
        categorical = [v for x, v in known.items() if "categorical" in x]
        if continuous and categorical:
            said.append(
                f"latents: {described['latent']}, so the continuous ones are "
                + ("better" if min(continuous) > max(categorical) else "not clearly better")
            )
        if "curriculum" in described:
            said.append(f"curricula: {described['curriculum']}")
        parts.append("; ".join(said) + ".")
    return " ".join(parts)


def body(report: Mapping[str, Any]) -> list[str]:
    """What was searched with, and the table of final judgements."""
    plan = report["plan"]
    sizes = "; ".join(
        f"{name}: {x['generations']} generations of {x['population_size']} candidates with "
        f"{x['agents_per_candidate']} agents, {x['seeds']} searches a line"
        for name, x in plan["environments"].items()
    )
    algorithms = ", ".join(x.upper() for x in plan["algorithms"]) or "all of the paper's algorithms"
    lines = []
    for environment in ENVIRONMENTS:
        for row, labels in rows(environment).items():
            for label, search in labels.items():
                found = finals(report, environment, search)
                seconds = [
                    c["seconds"]
                    for c in report["environments"][environment].get(search, {}).values()
                ]
                lines.append(
                    [
                        environment,
                        row,
                        label,
                        "all failed" if found is None else text(found, 1),
                        f"{_worst_failing(report, environment, search):.0%}",
                        f"{np.mean(seconds):.0f}" if seconds else "",
                    ]
                )
    return [
        f"SNES from random weights with standard deviation 0.05, inner loop: {algorithms} with hyperparameters drawn "
        f"from the paper's lists, {plan['episodes']} evaluation episodes. {sizes}. The mean of the search distribution "
        f"is judged by {plan['mean_evaluations']} agents; a line is the mean over searches of their interquartile "
        "mean, with the 95 % bootstrap interval over searches. T: transition, reward and termination are learned; "
        "TI: and the initial state; I: a bandit; IC: with a linear curriculum of the evaluation's length. "
        "*Without a number* is the largest share of candidates that failed (NaN or infinite states) between two "
        "judgements.",
        "",
        *table(
            ["environment", "row", "", "final return", "without a number", "seconds a search"],
            lines,
        ),
    ]


def draw(report: Mapping[str, Any]) -> "Figure":
    """The paper's six panels; a line is left out where a search's mean failed."""
    from matplotlib.figure import Figure

    from scb import plotting

    colors = (
        plotting.BLACK,
        plotting.ORANGE,
        plotting.BLUE,
        plotting.VERMILLION,
        plotting.GREEN,
        plotting.PURPLE,
    )
    styles = ("-", "--", "-.", ":", (0, (3, 1, 1, 1)), (0, (5, 1)))
    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 8.4))
        panels: Any = figure.subplots(3, len(ENVIRONMENTS))
        for column, environment in enumerate(ENVIRONMENTS):
            drawn = rows(environment)
            for axes, row in zip(
                panels[:, column], ("what is learned", "latent", "curriculum"), strict=True
            ):
                if row not in drawn:
                    axes.axis("off")
                    axes.text(0.5, 0.5, "the paper has no curriculum for it", ha="center")
                    continue
                for (label, search), color, style in zip(
                    drawn[row].items(), colors, styles, strict=False
                ):
                    plotting.search_curve(
                        axes,
                        list(report["environments"][environment].get(search, {}).values()),
                        label,
                        color,
                        style,
                    )
                axes.set_title(f"{environment}: {row}")
                axes.set_xlabel("generation")
                axes.set_ylabel("return of agents")
                axes.legend(fontsize=8, ncols=2)
        plotting.figure_title(
            figure, "Meta-training curves: mean over searches, 95 % interval over searches"
        )
    return figure


def _presets() -> dict[str, dict[str, Any]]:
    shared = {"evaluate_mean_every": 5}
    return {
        "quick": {
            **shared,
            "runs": "runs/ablations/quick",
            "algorithms": ["ppo"],
            "episodes": 8,
            "mean_evaluations": 16,
            "environments": {
                "Pendulum-v1": {
                    "generations": 60,
                    "population_size": 16,
                    "agents_per_candidate": 1,
                    "seeds": 2,
                },
                "MountainCar-v0": {
                    "generations": 30,
                    "population_size": 16,
                    "agents_per_candidate": 1,
                    "seeds": 2,
                },
            },
        },
        "paper": {
            **shared,
            "runs": "runs/ablations/paper",
            "algorithms": [],
            "episodes": 50,
            "mean_evaluations": 64,
            "environments": {
                "Pendulum-v1": {
                    "generations": 1000,
                    "population_size": 64,
                    "agents_per_candidate": 8,
                    "seeds": 5,
                },
                "MountainCar-v0": {
                    "generations": 1000,
                    "population_size": 128,
                    "agents_per_candidate": 1,
                    "seeds": 20,
                },
            },
        },
    }


EXPERIMENT = Experiment(
    name="ablations",
    title="What the meta-evolution needs",
    paper="figure 9, appendix on ablations of the meta-evolution algorithm",
    claim="learning the transition alone (T) is beaten by learning the initial state too (TI), and never reaches the "
    "goal of MountainCar; one step (I) is as good as many, apart from some searches on Pendulum, and spares the "
    "overflows of long episodes; a curriculum helps MountainCar (IC), whatever its shape; continuous latents are "
    "better than categorical ones.",
    presets=_presets(),
    minutes={"quick": "35", "paper": "weeks; for a GPU"},
    measure=measure,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="run folders under runs/ablations",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
