"""What `lpo train` and `lpo evaluate` do: agents train with given objectives, and their rows are kept."""

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from lpo import figures
from lpo.comparison import Comparison, LearningCurves, compare, ppo_spec
from lpo.measuring import Agents, OfObjectives
from lpo.objectives import REFERENCES, Objective, learned_in, load_objective
from lpo.suite import SuiteScores, run_suite, suite_specs
from lpo.suite import suite as suite_environments
from scb import plotting
from scb.command_line import text
from scb.configurations import config_dict
from scb.console import console
from scb.environments.registry import check_backend
from scb.errors import UserError
from scb.files import write_json
from scb.lists import read_settings, write_settings
from scb.machine import package_versions
from scb.measurement import Place
from scb.statistics import estimate


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class JudgedConfig(Agents):
    """Agents that are judged along their training.

    Attributes:
      seeds: agents of each objective.
      hyperparameters: of PPO, where they are other than the environment's own setting (such as learning_rate=0.0003
        num_envs=8 policy_output_scale=0.01): those of the PPO that an objective is to be used in.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
    """

    seeds: int = 1
    hyperparameters: Annotated[
        Mapping[str, Any], text(read_settings, write_settings, "NAME=A NAME=B", spaced=True)
    ] = field(default_factory=dict)
    sampled_actions: bool = False


@dataclass(frozen=True)
class TrainConfig(JudgedConfig):
    """What `lpo train` does.

    Attributes:
      objective: ppo, ppo-0.3 (clip 0.3), dpo, dpo-4-1.2 (its alpha and beta), none, a zoo name, path.npz, or
        package.module:function of your own.
    """

    objective: str = "ppo"

    @property
    def objectives(self) -> tuple[str, ...]:
        return (self.objective,)


@dataclass(frozen=True)
class EvaluateConfig(JudgedConfig):
    """What `lpo evaluate` does.

    Attributes:
      suite: train in every environment of classic, minatar, brax or all, and aggregate normalised
        scores; a folder given as --out that holds a part of them already is completed.
      objectives: any of ppo, ppo-0.3, dpo, dpo-4-1.2, none, zoo names, files, package.module:function of your
        own; the first is the reference of the differences.
    """

    seeds: int = 10
    seed: int = 1000
    suite: str | None = None
    objectives: tuple[str, ...] = REFERENCES

    def __post_init__(self) -> None:
        if not self.objectives:
            raise UserError("no objectives: give at least one, such as --objectives ppo dpo.")
        if self.suite is not None and self.environment is not None:
            raise UserError(
                f"the environment {self.environment} and the suite {self.suite} are both given: leave one out."
            )


@dataclass(frozen=True, kw_only=True)
class Comparing(OfObjectives):
    """A command that compares objectives on one environment."""

    def growing(self) -> Collection[str]:
        # A suite's --out that is there is completed, and grows by nothing but --resume.
        return () if self.output.out else ("seeds", "objectives")

    def compare(self, objectives: Sequence[Objective]) -> Comparison:
        """Trains with the objectives, and leaves rows, comparison.json and curves.png where a folder is named."""
        config: JudgedConfig = self.config
        environment = "Pendulum-v1" if config.environment is None else config.environment
        seeds = config.seed_list()
        spec = ppo_spec(environment, config.steps, config.hyperparameters)
        Place.named(environment, config.backend)  # a mistake must not leave a folder behind
        folder, rows = self.opened()
        comparison = compare(
            environment,
            objectives,
            seeds,
            spec=spec,
            backend=config.backend,
            mode_actions=not config.sampled_actions,
            rows=rows,
            tell=_tell,
        )
        if folder is not None:
            write_json(
                folder / "comparison.json", {**comparison.as_dict(), "versions": package_versions()}
            )
            plotting.save(figures.learning_curves(comparison.curves), folder / "curves.png")
        return comparison


@dataclass(frozen=True, kw_only=True)
class Train(Comparing):
    """Train PPO with an objective in an environment, and print how well it ends."""

    program = "lpo train"
    presets = MappingProxyType({"quick": lambda given: TrainConfig()})

    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        comparison = self.compare([load_objective(self.config.objective)])
        (curves,) = comparison.curves
        for point, returns in zip(curves.steps, curves.returns.T, strict=True):
            print(f"{point:>9} steps: return {np.mean(returns):.1f}")
        print(f"final return, IQM: {estimate(curves.final)}")
        if comparison.caution:
            print(comparison.caution)


@dataclass(frozen=True, kw_only=True)
class Evaluate(Comparing):
    """Compare objectives: train PPO with each on the same seeds, and print final scores with intervals.

    With --out every agent's returns are kept in rows.jsonl as they come, for --resume and for
    other statistics: pandas.read_json("rows.jsonl", lines=True). A resumed comparison may have more --seeds
    and further --objectives: what is there is kept.
    """

    program = "lpo evaluate"
    presets = MappingProxyType({"quick": lambda given: EvaluateConfig()})

    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(
        default_factory=EvaluateConfig
    )

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> "Evaluate":
        command = super().parse(arguments)
        kept = command.output
        if command.config.suite is None or kept.out is None or kept.resume is not None:
            return command
        # Other flags than the folder's are refused, not replaced by its own.
        resume = kept.out if (kept.out / "config.json").exists() else None
        return replace(command, output=replace(kept, resume=resume))

    def run(self) -> None:
        objectives = self.loaded()
        if self.config.suite is not None:
            self.run_suite(self.config.suite, objectives)
            return
        comparison = self.compare(objectives)
        first, *_ = comparison.curves
        columns = ["objective", "final IQM [95 %]", "area under the curve"]
        table = Table(*columns, f"difference to {first.objective}")
        if first.standing_still is not None:
            table.add_column(f"above standing still ({first.standing_still:g})")
            table.add_column("m/s")
            table.add_column("steps an episode")
        differences = comparison.differences()
        for c in comparison.curves:
            final, area = str(estimate(c.final)), str(estimate(c.area))
            cells = [c.objective, final, area, str(differences.get(c.objective, ""))]
            table.add_row(*cells, *_moving(c))
        console().print(table)
        said = (f"after {first.steps[-1]} steps", comparison.caution, comparison.few)
        for words in filter(None, said):
            console().print(words)

    def run_suite(self, name: str, objectives: Sequence[Objective]) -> None:
        config, seeds = self.config, self.config.seed_list()
        environments = suite_environments(name)
        check_backend(config.backend, environments)
        suite_specs(name, config.steps, config.hyperparameters)
        homes = learned_in(objectives)
        (folder, rows), printer = self.opened(), console()
        scores, comparisons = run_suite(
            name,
            objectives,
            seeds,
            config.backend,
            tell=printer.print,
            rows=rows,
            steps=config.steps,
            hyperparameters=config.hyperparameters,
            mode_actions=not config.sampled_actions,
        )
        title, caption = "final return, IQM [95 %]", f"suite: {name}"
        table = Table("environment", *scores.objectives, title=title, caption=caption)
        for environment, comparison in comparisons.items():
            table.add_row(environment, *(str(estimate(c.final)) for c in comparison.curves))
        printer.print(table)
        printer.print(_scores_table(scores, "over all of them"))
        elsewhere = scores.without(*homes) if {*homes} & {*scores.environments} else None
        if elsewhere is not None:
            where = f"without {', '.join(homes)}, for which one of them was learned"
            printer.print(_scores_table(elsewhere, where))
        if few := next(iter(comparisons.values())).few:
            printer.print(few)
        if scores.left_out:
            printer.print(f"left out, nobody beat random actions: {', '.join(scores.left_out)}")
        if folder is not None:
            for environment, comparison in comparisons.items():
                path = folder / "comparisons" / f"{environment}.json"
                path.parent.mkdir(exist_ok=True)
                write_json(path, comparison.as_dict())
            content = {
                **config_dict(config),
                "seeds": seeds,
                **scores.as_dict(),
                "elsewhere": None if elsewhere is None else elsewhere.as_dict(),
                "versions": package_versions(),
            }
            write_json(folder / "suite.json", content)
            plotting.save(figures.suite_scores(scores, name), folder / "suite.png")
            if elsewhere is not None:
                drawn = figures.suite_scores(elsewhere, f"{name} without {', '.join(homes)}")
                plotting.save(drawn, folder / "suite_elsewhere.png")


def _scores_table(scores: SuiteScores, where: str) -> Table:
    first, *_ = scores.objectives
    table = Table(
        "objective", "normalised score, IQM [95 %]", f"difference to {first}", title=where
    )
    found = zip(scores.objectives, scores.aggregate(), scores.differences(), strict=True)
    for objective, score, difference in found:
        table.add_row(objective, str(score), "" if objective == first else str(difference))
    return table


def _moving(curves: LearningCurves) -> tuple[str, ...]:
    """How many agents end above standing still, their mean speed and length of episodes; empty where none is known."""
    standing, speeds, lengths = curves.standing_still, curves.speeds, curves.lengths
    if standing is None or speeds is None or lengths is None:
        return ()
    above = int((curves.final > standing).sum())
    share = f"{above} of {len(curves.final)}"
    length = f"{np.nanmean(lengths[:, -1]):.0f}"
    # Not every environment tells a speed.
    known = np.isfinite(speeds[:, -1]).any()
    return share, f"{np.nanmean(speeds[:, -1]):.2f}" if known else "", length
