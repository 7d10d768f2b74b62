"""What the meta-evolution needs: learned initial states, no transitions, continuous latents, curricula.

    python -m experiments ablations

Searches from random weights that differ in one thing each: what of the synthetic environment is
learned (T the transition, I the initial state, C with a curriculum), the latent's distribution, the
curriculum's shape. Run folders are under runs/ablations and are resumed.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import searches
from experiments.claims import ENOUGH, OF_THE_WAY, Claim, of_the_way
from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report
from experiments.searches import NONE
from scb import plotting
from scb.discovery import DiscoveryConfig
from scb.environments.registry import environment_spec
from scb.environments.synthetic import BanditConfig

# The paper's two, and Acrobot, where searches of a laptop's size come to something.
ENVIRONMENTS = ("Pendulum-v1", "MountainCar-v0", "Acrobot-v1")
# The paper has none for the others.
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


def seeds_of(plan: Mapping[str, Any], environment: str, search: str) -> int:
    """How many searches of a kind the plan has."""
    usual: int = plan["environments"][environment]["seeds"]
    more: Mapping[str, int] = plan["more_seeds"].get(environment, {})
    return more.get(search, usual)


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Searches, seeds outermost, so that an interrupted run has all lines."""
    number = {(x, name): seeds_of(plan, x, name) for x in ENVIRONMENTS for name in searches_of(x)}
    for seed in range(max(number.values())):
        for environment, name in number:
            if seed < number[environment, name]:
                folder = f"{plan['runs']}/{environment}/{name.replace(' | ', '-')}-{seed}"
                config = config_of(environment, name, seed, plan)
                searched = partial(searches.searched_curve, config, folder)
                yield Part(("environments", environment, name, str(seed)), searched)


measure = InParts(parts)


def planned(report: Mapping[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """{environment: {search: {seed: curve}}} of as many searches of a kind as the report's plan has.

    Who looks at a difference while it grows sees it pass its margin sooner or later: what was made beyond the plan
    counts when the plan has it, that is when all are there.
    """
    return {
        environment: {
            search: {
                seed: curve
                for seed, curve in curves.items()
                if int(seed) < seeds_of(report["plan"], environment, search)
            }
            for search, curves in of_it.items()
        }
        for environment, of_it in report["environments"].items()
    }


def _never_reached(report: Mapping[str, Any], environment: str, search: str) -> bool:
    """Whether no agent of any judgement earned more than one that never reaches the goal."""
    curves = planned(report)[environment][search].values()
    means = [x for c in curves for x in c["mean"] if x is not None]
    return environment in WORST and bool(means) and max(means) <= WORST[environment]


def _at_the_start(report: Mapping[str, Any], environment: str) -> bool:
    """Whether no search ends a tenth of the way from random actions to the expert: such searches test no claim."""
    least = environment_spec(environment).random_return() + of_the_way(environment)
    curves = planned(report)[environment]
    return all(
        x < least for search in searches_of(environment) for x in searches.last(curves[search])
    )


def claims(report: Report) -> list[Claim]:
    """For each environment: TI above T, I not below TI, continuous latents; then T's goal and every curriculum."""
    return [claim for environment in ENVIRONMENTS for claim in _claims_of(report, environment)]


def _claims_of(report: Report, environment: str) -> list[Claim]:
    curves, untold = planned(report)[environment], _at_the_start(report, environment)

    def above(text: str, row: str, label: str, other: str, margin: float = 0.0) -> Claim:
        one, than = (curves[rows(environment)[row][x]] for x in (label, other))
        evidence = None if untold else searches.difference(one, than, np.mean)
        reason = OF_THE_WAY if margin else ""
        return Claim(f"{environment}: {text}", evidence, 0.0, margin, reason, places=0)

    found = [
        above("TI is better than T", "what is learned", "TI", "T"),
        above("I is no worse than TI", "what is learned", "I", "TI", of_the_way(environment)),
    ]
    for latent in ("normal", "uniform"):
        for other in ("categorical, equal", "categorical, softmax"):
            text = f"{latent} latents are better than {other} ones"
            found.append(above(text, "latent", latent, other))
    if environment in WITH_CURRICULUM:
        never = _never_reached(report, environment, name_of("T", "normal", NONE))
        text = f"{environment}: with T no agent ever reaches the goal"
        found.append(Claim(text, None if untold else never))
        found += [
            above(f"the {x} curriculum is better than none", "curriculum", x, NONE) for x in SHAPES
        ]
    return found


def facts(report: Report) -> dict[str, Any]:
    """{environment: {row of the figure: {label: what its searches were worth}}}, and where they led nowhere."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    made = planned(report)
    for environment in ENVIRONMENTS:
        candidates = report["plan"]["environments"][environment]["population_size"]
        for row, labels in rows(environment).items():
            of_it = found.setdefault(environment, {}).setdefault(row, {})
            for label, search in labels.items():
                curves = made[environment][search]
                of_it[label] = {
                    "final": searches.final(curves, np.mean),
                    "failing": max(max(c["failed"]) for c in curves.values()) / candidates,
                    "seconds": float(np.mean([c["seconds"] for c in curves.values()])),
                    "machines": searches.ran_on(curves.values(), report),
                }
    untold = [x for x in ENVIRONMENTS if _at_the_start(report, x)]
    all_of_them = (c for x in made.values() for s in x.values() for c in s.values())
    ran = searches.elsewhere(all_of_them, report)
    return {"rows": found, "untold": untold, "enough": ENOUGH, "elsewhere": ran}


def draw(report: Mapping[str, Any]) -> Figure:
    """The paper's panels, and Acrobot's, of which something moves; a line is left out where a search's mean failed."""
    made = planned(report)
    found = {
        f"{environment}:\n{row}": {
            label: list(made[environment][search].values()) for label, search in drawn.items()
        }
        for environment in ENVIRONMENTS
        for row, drawn in rows(environment).items()
    }
    moving = {title: lines for title, lines in found.items() if _moves(lines.values())}
    figure = Figure(figsize=(plotting.WIDTH, 0.6 + 3.0 * -(-len(moving) // 2)))
    for axes, (title, lines) in zip(
        plotting.panels(figure, len(moving)), moving.items(), strict=True
    ):
        for (label, curves), look in zip(lines.items(), plotting.LINES, strict=False):
            plotting.search_curve(axes, curves, label, look)
        axes.set_title(title, fontsize=10)
        axes.set(xlabel="generation", ylabel="return of agents")
        axes.legend(fontsize=7, handlelength=1.8)
    plotting.figure_title(
        figure,
        "Meta-training curves: mean over searches, 95 % interval over them; of two or three, their range",
    )
    return figure


def _moves(searched: Iterable[Sequence[Mapping[str, Any]]]) -> bool:
    """Whether not all means of all searches are the same number."""
    return len({x for curves in searched for c in curves for x in c["fitness"]} - {None}) > 1


EXPERIMENT = Experiment.of_the_paper("ablations", measure, draw, claims, facts=facts)
