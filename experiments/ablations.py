"""What the meta-evolution needs: learned initial states, no transitions, continuous latents, curricula.

    python -m experiments.ablations

Searches from random weights that differ in one thing each: what of the synthetic environment is
learned (T the transition, I the initial state, C with a curriculum), the latent's distribution, the
curriculum's shape. Run folders are under runs/ablations and are resumed.
"""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import searches
from experiments.page import Experiment, Save, table
from experiments.page import main as run
from experiments.searches import ENOUGH, NONE, PAPER_SIZES, Final
from scb import plotting
from scb.discovery import DiscoveryConfig
from scb.environments.synthetic import BanditConfig

ENVIRONMENTS = ("Pendulum-v1", "MountainCar-v0")
# The paper finds no curriculum for Pendulum.
WITH_CURRICULUM = ("MountainCar-v0",)
WORST = {"MountainCar-v0": -200.0}  # what an agent earns that never reaches the goal
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


def searches_of(environment: str) -> list[str]:
    """Every search of an environment once."""
    return list(dict.fromkeys(s for row in rows(environment).values() for s in row.values()))


def config_of(environment: str, search: str, seed: int, plan: Mapping[str, Any]) -> DiscoveryConfig:
    """The search's configuration: the paper's recipe, at the plan's size."""
    parameterization, latent, shape = search.split(" | ")
    size = plan["environments"][environment]
    return searches.config_of(
        environment,
        plan,
        size,
        seed,
        parameterization=parameterization,
        bandit=BanditConfig(latent=latent),
        curriculum=searches.curriculum_of(environment, shape, size["generations"]),
    )


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A search at a time, seeds outermost, so that an interrupted run has all lines."""
    found = report.setdefault("environments", {name: {} for name in ENVIRONMENTS})
    for seed in range(max(x["seeds"] for x in plan["environments"].values())):
        for environment in ENVIRONMENTS:
            for name in searches_of(environment):
                curves = found[environment].setdefault(name, {})
                if str(seed) in curves or seed >= plan["environments"][environment]["seeds"]:
                    continue
                folder = f"{plan['runs']}/{environment}/{name.replace(' | ', '-')}-{seed}"
                config = config_of(environment, name, seed, plan)
                curves[str(seed)] = searches.searched_curve(config, folder)
                save()


def finals(report: Mapping[str, Any], environment: str, search: str) -> Final:
    """The last judgement, the mean over searches."""
    return searches.final(report["environments"][environment][search], np.mean)


def _worst_failing(report: Mapping[str, Any], environment: str, search: str) -> float:
    most = max(max(c["failed"]) for c in report["environments"][environment][search].values())
    size = report["plan"]["environments"][environment]["population_size"]
    return float(most / size)


def _never_reached(report: Mapping[str, Any], environment: str, search: str) -> bool:
    """Whether no agent of any judgement earned more than one that never reaches the goal."""
    curves = report["environments"][environment][search].values()
    means = [x for c in curves for x in c["mean"] if x is not None]
    return environment in WORST and bool(means) and max(means) <= WORST[environment]


def _rows(report: Mapping[str, Any], environment: str) -> dict[str, dict[str, Final]]:
    """{row of the figure: {label: what its searches were worth}}."""
    return {
        row: {label: finals(report, environment, search) for label, search in labels.items()}
        for row, labels in rows(environment).items()
    }


def _goal_unseen(report: Mapping[str, Any], environment: str) -> bool:
    """Whether no agent of any search ever reached the goal."""
    return all(_never_reached(report, environment, x) for x in searches_of(environment))


def _few(report: Mapping[str, Any], environment: str) -> bool:
    return int(report["plan"]["environments"][environment]["seeds"]) < ENOUGH


def _continuous_better(found: Mapping[str, Final]) -> bool:
    """Whether every continuous latent is clearly better than every categorical one."""
    categorical = {label for label in found if "categorical" in label}
    return all(
        found[x].clearly_above(found[y]) for x in found.keys() - categorical for y in categorical
    )


def _helpful(found: Mapping[str, Final]) -> list[str]:
    """The curricula that are clearly better than none."""
    return [x for x, e in found.items() if e.clearly_above(found[NONE])]


def parts(report: Mapping[str, Any]) -> list[bool | None]:
    """For each environment: TI above T, I not below TI, continuous latents; then T's goal and every curriculum.

    None where there are too few searches, or none that got anywhere.
    """
    told: list[bool | None] = []
    for environment in ENVIRONMENTS:
        found = _rows(report, environment)
        learned = found["what is learned"]
        of_it: list[bool | None] = [
            learned["TI"].clearly_above(learned["T"]),
            not learned["TI"].clearly_above(learned["I"]),
            _continuous_better(found["latent"]),
        ]
        if environment in WITH_CURRICULUM:
            helpful = _helpful(found["curriculum"])
            of_it.append(_never_reached(report, environment, name_of("T", "normal", NONE)))
            of_it += [x in helpful for x in SHAPES]
        untold = _few(report, environment) or _goal_unseen(report, environment)
        told += [None] * len(of_it) if untold else of_it
    return told


def verdict(report: Mapping[str, Any]) -> str:
    """The paper's claims in its order, each with its figures; "clearly" where intervals are apart."""
    told = []
    for environment in ENVIRONMENTS:
        if _goal_unseen(report, environment):
            told.append(
                f"{environment}: no agent of any search reaches the goal after so few generations, which leaves the "
                "paper's claims about it untested."
            )
            continue
        found = _rows(report, environment)
        described = {
            row: ", ".join(f"{label} {x.text()}" for label, x in estimates.items())
            for row, estimates in found.items()
        }
        learned = found["what is learned"]
        few = _few(report, environment)
        said = [
            f"{environment}"
            + (" (too few searches to tell anything clearly apart)" if few else "")
            + f": {described['what is learned']}",
            f"TI {_compared(learned['TI'], learned['T'])} T, I {_compared(learned['I'], learned['TI'])} TI",
        ]
        if _never_reached(report, environment, name_of("T", "normal", NONE)):
            said.append("with T no agent ever reaches the goal, as in the paper")
        better = (
            "clearly better" if _continuous_better(found["latent"]) else "not all clearly better"
        )
        said += [f"latents: {described['latent']}", f"the continuous ones are {better}"]
        if "curriculum" in found:
            helpful = ", ".join(_helpful(found["curriculum"])) or "no shape"
            said.append(f"curricula: {described['curriculum']}")
            said.append(f"clearly better than none: {helpful}")
        told.append("; ".join(said) + ".")
    return " ".join(told)


def _compared(a: Final, b: Final) -> str:
    if a.clearly_above(b):
        return "is clearly better than"
    return "is clearly worse than" if b.clearly_above(a) else "is not clearly apart from"


def body(report: Mapping[str, Any]) -> list[str]:
    """What was searched with, and the table of final judgements."""
    plan = report["plan"]
    sizes = "; ".join(
        f"{name}: {x['generations']} generations of {x['population_size']} candidates (agents of each: "
        f"{x['agents_per_candidate']}), searches a line: {x['seeds']}"
        for name, x in plan["environments"].items()
    )
    algorithms = searches.algorithms_text(plan["algorithms"])
    lines = []
    for environment in ENVIRONMENTS:
        for row, labels in rows(environment).items():
            for label, search in labels.items():
                found = finals(report, environment, search)
                seconds = [
                    c["seconds"] for c in report["environments"][environment][search].values()
                ]
                lines.append(
                    [
                        environment,
                        row,
                        label,
                        found.text(1),
                        f"{_worst_failing(report, environment, search):.0%}",
                        f"{np.mean(seconds):.0f}",
                    ]
                )
    return [
        f"SNES from random weights with standard deviation 0.05, inner loop: {algorithms} with hyperparameters drawn "
        f"from the paper's lists, {plan['evaluation_episodes']} evaluation episodes. {sizes}. The mean of the "
        f"search distribution is judged by {plan['mean_evaluations']} agents; a line is the mean over searches of "
        "their interquartile mean, with the 95 % bootstrap interval over searches. T: transition, reward and "
        "termination are learned; TI: and the initial state; I: a bandit; IC: with a linear curriculum of the "
        "evaluation's length, with which MountainCar's latents are searched too. "
        "*Without a number* is the largest share of candidates that failed (NaN or infinite returns) between two "
        "judgements; networks are the paper's, with one hidden layer of tanh, whose states are bounded, unlike those "
        "of the ReLU networks in the authors' released code.",
        "",
        *table(
            ["environment", "row", "", "final return", "without a number", "seconds a search"],
            lines,
        ),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """The paper's six panels; a line is left out where a search's mean failed."""

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
                    curves = list(report["environments"][environment][search].values())
                    plotting.search_curve(axes, curves, label, color, style)
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
            "evaluation_episodes": 8,
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
                    "seeds": 1,
                },
            },
        },
        "paper": {
            **shared,
            "runs": "runs/ablations/paper",
            "algorithms": [],
            "evaluation_episodes": 50,
            "mean_evaluations": 64,
            "environments": {
                "Pendulum-v1": {**PAPER_SIZES["Pendulum-v1"], "seeds": 5},
                "MountainCar-v0": {**PAPER_SIZES["MountainCar-v0"], "seeds": 20},
            },
        },
    }


EXPERIMENT = Experiment(
    name="ablations",
    title="What the meta-evolution needs",
    paper="figure 14, appendix on ablations of the meta-evolution algorithm",
    claim="learning the transition alone (T) is beaten by learning the initial state too (TI), and never reaches the "
    "goal of MountainCar; one step (I) is as good as many, apart from some searches on Pendulum, and spares the "
    "overflows of long episodes; a curriculum helps MountainCar (IC), whatever its shape; continuous latents are "
    "better than categorical ones.",
    presets=_presets(),
    minutes={"quick": "30", "paper": "weeks; for a GPU"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="keeps its searches under runs/ablations",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
