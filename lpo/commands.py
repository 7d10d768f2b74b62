"""What the subcommands of `lpo` do. Their docstrings are the command line's help."""

import inspect
import itertools
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.table import Table

from lpo import figures, learning
from lpo.alignment import Regime, correlation_text, known_drifts, measure_alignment
from lpo.certificate import certify
from lpo.comparison import Comparison, check_names, compare
from lpo.distill import DistillConfig, distill
from lpo.fitness import LABELS
from lpo.objectives import Objective, load_objective, save_objective
from lpo.pipeline import PRESETS as RUN_PRESETS
from lpo.pipeline import check_settings, run_pipeline
from lpo.suite import run_suite
from lpo.suite import suite as suite_environments
from scb import plotting
from scb.agents.spec import environment_agent
from scb.artefacts import machine_description, package_versions
from scb.console import console
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least
from scb.measurement import Rows
from scb.runs import Run, make_folder, read_config, write_json
from scb.statistics import estimate


def seed_list(count: int, first: int, counted: str = "seeds") -> list[int]:
    """`count` consecutive seeds; a UserError, which says what is `counted`, for none or a negative one."""
    at_least(1, **{counted: count})
    at_least(0, seed=first)
    return list(range(first, first + count))


def run(
    preset: str | None = None,
    seed: int | None = None,
    out: Path = Path("runs/quick"),
    resume: Path | None = None,
    objective: str | None = None,
) -> None:
    """The whole path: learn an objective on the Pendulum bandit, train PPO with it, judge it.

    Meta-trains a drift on the shipped bandit, then trains PPO with its own clip, with DPO and with
    the learned drift on Pendulum and on Brax Hopper, on the same seeds, and writes report.html,
    figures and results.json.

    Args:
      preset: quick (eight minutes on two cores) or paper (the paper's sizes; hours).
      seed: decides everything; the seeds that report are apart from those that learn.
      out: folder to write; must be new or empty.
      resume: a folder that an earlier, interrupted `lpo run` wrote: do what is missing there.
      objective: take this objective (a zoo name or file.npz) instead of learning one.
    """
    settings = learning.settle(
        {"command": "run", "seed": seed, "objective": objective}, RUN_PRESETS, preset, resume
    )
    settings["seed"] = settings.get("seed") or 0
    if resume is None:
        check_settings(settings)  # a mistake must not leave a folder behind
    folder = Run.open(resume or out, settings, resume=resume is not None)
    # Not as typed: resuming goes on with these settings, and this is what starts them afresh.
    chosen = {name: settings[name] for name in ("preset", "seed", "objective")}
    flags = [f"--{name}={value}" for name, value in chosen.items() if value is not None]
    report = run_pipeline(folder, settings, shlex.join(["lpo", "run", *flags]))
    console().print(f"report: {report}", soft_wrap=True)


def meta_train_command(
    environment: str | None = None,
    tasks: str | None = None,
    preset: str | None = None,
    seed: int | None = None,
    out: Path = Path("runs/meta-train"),
    resume: Path | None = None,
    fitness: str | None = None,
    reward_noise: float | None = None,
    drift: str | None = None,
    base: str | None = None,
    xi: float | None = None,
    gate: float | None = None,
    temporal: bool = False,
    horizons: str | None = None,
    hyperparameters: str | None = None,
    combine: str | None = None,
    strategy: str | None = None,
    population_size: int | None = None,
    generations: int | None = None,
    agents_per_candidate: int | None = None,
    sigma: float | None = None,
    learning_rate: float | None = None,
    contexts: int | None = None,
    evaluation_episodes: int | None = None,
    validate: bool = False,
    mean_evaluations: int | None = None,
    evaluate_mean_every: int | None = None,
    backend: str | None = None,
    wandb: str | None = None,
) -> None:
    """Learn an objective: evolve a drift on a bandit, or on an environment.

    Args:
      environment: where the inner loop trains: Synthetic-Pendulum-v1, Pendulum-v1, hopper, ...
      tasks: several of them at once, separated by commas; observations and actions may differ.
      preset: quick (30 generations of 32) or paper (512 of 64); single flags override it.
      seed: decides everything.
      out: folder to write; must be new or empty.
      resume: a run folder to continue; its settings apply, and a flag that contradicts them is an
        error.
      fitness: return (of the trained agent where it was trained, without noise), return-sampled (with
        sampled actions rather than the most likely ones), area (the mean over the training), or
        transfer (return of the bandit-trained agent in the bandit's evaluation environment).
      reward_noise: noise on the bandit's reward, in its standard deviations. Without it the drift
        overfits the bandit.
      drift: the family that is learned: network (Lu et al., 2022; the default) or another of
        `lpo.drifts`. The next four are settings of a network.
      base: ppo (the network corrects PPO's clip) or none.
      xi: half-width of the drift's dead zone.
      gate: width of the region around ratio 1 where the network is faded out, in nats; 0 for none.
      temporal: let the drift change over an agent's training; inner agents then train for random
        numbers of updates.
      horizons: how long inner agents train, as fractions of the setting's number of updates, such
        as 0.25,0.5,1; one is drawn for each generation. With --temporal 0.25,0.5,1,2 if left out.
      hyperparameters: values that inner agents draw theirs from, such as
        "learning_rate=0.0003,0.001 policy_output_scale=1,0.01".
      combine: how a candidate's agents and tasks count: mean, or ranks (the mean over them of its
        rank among the candidates; the default for several tasks).
      strategy: any of evosax's, by name (Open_ES, SNES, CMA_ES, ...).
      population_size: candidates a generation.
      generations: how many.
      agents_per_candidate: inner agents whose mean is a candidate's fitness.
      sigma: standard deviation of the search distribution.
      learning_rate: of the outer loop's Adam.
      contexts: contexts that a batch of the bandit holds.
      evaluation_episodes: of each inner agent.
      validate: judge the search distribution's mean by agents trained with it in the evaluation
        environment, and keep the mean that was judged best, rather than the final one.
      mean_evaluations: agents that judge the mean; with --validate 16 if left out.
      evaluate_mean_every: generations between those judgements.
      backend: Brax physics, for Brax environments.
      wandb: project to log to, with the extra `wandb`.
    """
    settings = learning.settle(
        {
            "command": "meta-train",
            "environment": environment,
            "tasks": tasks,
            "seed": seed,
            "fitness": fitness,
            "reward_noise": reward_noise,
            "drift": drift,
            "base": base,
            "xi": xi,
            "gate": gate,
            "temporal": temporal or None,
            "horizons": horizons,
            "hyperparameters": hyperparameters,
            "combine": combine,
            "strategy": strategy,
            "population_size": population_size,
            "generations": generations,
            "agents_per_candidate": agents_per_candidate,
            "sigma": sigma,
            "learning_rate": learning_rate,
            "contexts": contexts,
            "evaluation_episodes": evaluation_episodes,
            "validate": validate or None,
            "mean_evaluations": mean_evaluations,
            "evaluate_mean_every": evaluate_mean_every,
            "backend": backend,
        },
        learning.PRESETS,
        preset,
        resume,
    )
    path, certificate = learning.learn_objective(settings, resume or out, resume is not None, wandb)
    printer = console()
    printer.print(f"objective: {path}", soft_wrap=True)
    printer.print(f"it {certificate}")


def train(
    environment: str = "Pendulum-v1",
    objective: str = "ppo",
    steps: int | None = None,
    policy_output_scale: float | None = None,
    seeds: int = 1,
    seed: int = 0,
    backend: str | None = None,
    sampled_actions: bool = False,
    out: Path | None = None,
    resume: Path | None = None,
) -> None:
    """Train PPO with an objective in an environment, and print how well it ends.

    Args:
      environment: Pendulum-v1, CartPole-v1, hopper, Synthetic-Pendulum-v1, ...
      objective: ppo, ppo-0.3 (clip 0.3), dpo, none, a zoo name, or path.npz.
      steps: environment steps; the environment's own setting where left out.
      policy_output_scale: factor on the policy's last layer at initialisation; many public PPOs take
        0.01.
      seeds: agents to train.
      seed: the first of their seeds.
      backend: Brax physics: generalized, positional or spring.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
      out: folder for rows.jsonl, comparison.json and curves.png; must be new or empty.
      resume: a folder that an interrupted command wrote; its settings apply, and a flag that
        contradicts them is an error.
    """
    settings = _settings(
        train,
        {
            "command": "train",
            "environment": environment,
            "objective": objective,
            "steps": steps,
            "policy_output_scale": policy_output_scale,
            "seeds": seeds,
            "seed": seed,
            "backend": backend,
            "sampled_actions": sampled_actions,
        },
        resume,
    )
    comparison = _compare(settings, [load_objective(settings["objective"])], out, resume)
    (curves,) = comparison.curves
    for point, returns in zip(curves.steps, curves.returns.T, strict=True):
        print(f"{point:>9} steps: return {np.mean(returns):.1f}")
    print(f"final return, IQM: {estimate(curves.final)}")


def evaluate(
    environment: str | None = None,
    suite: str | None = None,
    objectives: tuple[str, ...] = ("ppo", "dpo"),
    steps: int | None = None,
    policy_output_scale: float | None = None,
    seeds: int = 10,
    seed: int = 1000,
    backend: str | None = None,
    sampled_actions: bool = False,
    out: Path | None = None,
    resume: Path | None = None,
) -> None:
    """Compare objectives: train PPO with each on the same seeds, and print final scores with intervals.

    With --out every agent's returns are kept in rows.jsonl as they come, for --resume and for
    other statistics: pandas.read_json("rows.jsonl", lines=True).

    Args:
      environment: where to train; Pendulum-v1 where neither this nor a suite is given.
      suite: train in every environment of classic, minatar, brax or all, and aggregate normalised
        scores; a folder given as --out that holds a part of them already is completed.
      objectives: any of ppo, ppo-0.3, dpo, none, zoo names, files; the first is the reference of
        the differences.
      steps: environment steps; the environment's own setting where left out.
      policy_output_scale: factor on the policy's last layer at initialisation; many public PPOs take
        0.01.
      seeds: agents of each objective.
      seed: the first of their seeds.
      backend: Brax physics: generalized, positional or spring.
      sampled_actions: evaluate sampled actions rather than the most likely ones.
      out: folder for rows.jsonl, comparison.json and curves.png; must be new or empty.
      resume: a folder that an interrupted command wrote; its settings apply, and a flag that
        contradicts them is an error.
    """
    if suite is not None and out is not None and (out / "config.json").exists():
        out, resume = None, out
    settings = _settings(
        evaluate,
        {
            "command": "evaluate",
            "environment": environment,
            "suite": suite,
            "objectives": objectives,
            "steps": steps,
            "policy_output_scale": policy_output_scale,
            "seeds": seeds,
            "seed": seed,
            "backend": backend,
            "sampled_actions": sampled_actions,
        },
        resume,
    )
    if not settings["objectives"]:
        raise UserError("no objectives: give at least one, such as --objectives ppo dpo.")
    loaded = _named_apart(settings["objectives"])
    if settings["suite"] is not None:
        if settings["environment"] is not None:
            raise UserError(
                f"the environment {settings['environment']} and the suite {settings['suite']} are both given: leave "
                "one out."
            )
        _evaluate_suite(settings, loaded, out, resume)
        return
    comparison = _compare(settings, loaded, out, resume)
    table = Table(
        "objective",
        "final IQM [95 %]",
        "area under the curve",
        f"difference to {settings['objectives'][0]}",
    )
    for row in comparison.table():
        difference = "" if row["difference"] is None else str(row["difference"])
        table.add_row(row["objective"], str(row["final"]), str(row["area"]), difference)
    console().print(table)


def _settings(
    command: Callable[..., None], given: Mapping[str, Any], resume: Path | None
) -> dict[str, Any]:
    """A command's flags; with `resume` those that the folder was started with, but for what is given now."""
    given = json.loads(json.dumps(given))
    if resume is None:
        return dict(given)
    default = {n: x.default for n, x in inspect.signature(command).parameters.items()}
    default = json.loads(json.dumps(default, default=str))
    changed = {name: x for name, x in given.items() if x != default.get(name)}
    stored = read_config(resume)
    if stored.get("command") != given["command"]:
        raise UserError(
            f"cannot resume {resume} with lpo {given['command']}: it is a folder of lpo {stored.get('command')}."
        )
    return {**stored, **changed}


def _opened(
    settings: Mapping[str, Any], out: Path | None, resume: Path | None
) -> tuple[Path | None, Rows]:
    """The folder of a command's results, and the rows in it; without a folder in memory."""
    if out is None and resume is None:
        return None, Rows()
    folder = Run.open(resume or out or "", settings, resume=resume is not None).folder
    return folder, Rows(folder / "rows.jsonl")


def _compare(
    settings: Mapping[str, Any],
    objectives: Sequence[Objective],
    out: Path | None,
    resume: Path | None,
) -> Comparison:
    """Trains with the objectives, and leaves rows, comparison.json and curves.png where a folder is named."""
    environment = settings["environment"] or "Pendulum-v1"
    spec = (
        environment_agent("ppo", environment)
        .with_steps(settings["steps"])
        .with_values(policy_output_scale=settings["policy_output_scale"])
    )
    seeds = seed_list(settings["seeds"], settings["seed"])
    folder, rows = _opened(settings, out, resume)
    comparison = compare(
        environment,
        objectives,
        seeds,
        spec=spec,
        backend=settings["backend"],
        mode_actions=not settings["sampled_actions"],
        rows=rows,
        tell=_tell,
    )
    if folder is not None:
        write_json(
            folder / "comparison.json", {**comparison.as_dict(), "versions": package_versions()}
        )
        plotting.save(figures.learning_curves(comparison.curves), folder / "curves.png")
    return comparison


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _evaluate_suite(
    settings: Mapping[str, Any],
    objectives: Sequence[Objective],
    out: Path | None,
    resume: Path | None,
) -> None:
    name, seeds = settings["suite"], seed_list(settings["seeds"], settings["seed"])
    suite_environments(name)
    folder, rows = _opened(settings, out, resume)
    printer = console()
    scores, comparisons = run_suite(
        name,
        objectives,
        seeds,
        settings["backend"],
        tell=printer.print,
        rows=rows,
        steps=settings["steps"],
        policy_output_scale=settings["policy_output_scale"],
        mode_actions=not settings["sampled_actions"],
    )
    reference = objectives[0].name
    table = Table(
        "environment",
        *scores.objectives,
        title="final return, IQM [95 %]",
        caption="suite: " + name,
    )
    for environment, comparison in comparisons.items():
        table.add_row(environment, *(str(estimate(c.final)) for c in comparison.curves))
    printer.print(table)
    aggregate = Table("objective", "normalised score, IQM [95 %]", f"difference to {reference}")
    differences = scores.differences()
    for i, (objective, score) in enumerate(zip(scores.objectives, scores.aggregate(), strict=True)):
        aggregate.add_row(objective, str(score), str(differences[i]) if i else "")
    printer.print(aggregate)
    if scores.left_out:
        printer.print(f"left out, nobody beat random actions: {', '.join(scores.left_out)}")
    if folder is not None:
        for environment, comparison in comparisons.items():
            path = folder / "comparisons" / f"{environment}.json"
            path.parent.mkdir(exist_ok=True)
            write_json(path, comparison.as_dict())
        content = {**settings, "seeds": seeds, **scores.as_dict(), "versions": package_versions()}
        write_json(folder / "suite.json", content)
        plotting.save(figures.suite_scores(scores), folder / "suite.png")


def align(
    bandits: tuple[str, ...] = ("Synthetic-Pendulum-v1",),
    environment: str | None = None,
    objectives: tuple[str, ...] = (),
    reward_noise: tuple[float, ...] = (0.0, 2.0, 5.0),
    contexts: tuple[int, ...] = (200,),
    iterations: tuple[int, ...] = (),
    learning_rates: tuple[float, ...] = (),
    epochs: tuple[int, ...] = (),
    minibatches: tuple[int, ...] = (),
    steps: int | None = None,
    policy_output_scale: float | None = None,
    agents: int = 16,
    seed: int = 500,
    backend: str | None = None,
    out: Path | None = None,
) -> None:
    """Measure which inner loop on a bandit ranks objectives as an environment does.

    Trains agents with a family of known objectives on the environment and in every combination of
    the values given, and prints Spearman's correlation of each fitness with the environment's final
    return. Choose a regime with it before meta-training.

    Args:
      bandits: zoo names or files.
      environment: whose outcome counts; the first bandit's own where left out.
      objectives: that join the family of PPO's clips, DPO's and none: zoo names, files.
      reward_noise: in the bandit's standard deviations of reward.
      contexts: of a batch.
      iterations: of the inner loop; the environment's own setting where left out, as the following.
      learning_rates: of the inner agents.
      epochs: passes over a batch.
      minibatches: of a batch.
      steps: environment steps of the outcome's agents; the environment's own where left out.
      policy_output_scale: factor on the policy's last layer at initialisation, in the environment and
        in every regime.
      agents: of each objective, in the environment and in each regime.
      seed: the first of their seeds.
      backend: Brax physics: generalized, positional or spring.
      out: folder for alignment.json and alignment.png; must be new or empty.
    """
    family = [*known_drifts(), *_named_apart(objectives)]
    regimes = [
        Regime(*values, policy_output_scale=policy_output_scale)
        for values in itertools.product(
            bandits,
            reward_noise,
            contexts,
            iterations or (None,),
            epochs or (None,),
            minibatches or (None,),
            learning_rates or (None,),
        )
    ]
    if not regimes:
        raise UserError("no regimes: give at least one value of each.")
    target = environment or environment_spec(regimes[0].bandit).evaluation_environment
    seeds = seed_list(agents, seed, "agents")
    if out is not None:
        _make_folder(out)
    printer = console()
    report = measure_alignment(
        regimes, family, target, seeds, steps, backend, policy_output_scale, printer.print
    )
    table = Table("regime", *LABELS, title=f"Spearman's correlation with {target} [95 %]")
    for row in report["regimes"]:
        cells = (row["alignment"][fitness] for fitness in LABELS)
        table.add_row(row["name"], *(correlation_text(cell) for cell in cells))
    printer.print(table)
    if out is not None:
        write_json(out / "alignment.json", report)
        plotting.save(figures.alignment_heatmap(report), out / "alignment.png")


def distill_command(
    objective: tyro.conf.Positional[str],
    samples: int = 1000,
    population_size: int = 1000,
    generations: int = 20,
    seed: int = 0,
    out: Path = Path("runs/distill"),
) -> None:
    """Write a learned objective down as a formula: symbolic regression with gplearn (extra `distill`).

    Prints the formula, how well it fits the drift and its slope on points that the fit has not seen,
    and its certificate. --out/closed_form.npz is an objective like any other.

    Args:
      objective: a zoo name or path.npz.
      samples: points of the fit.
      population_size: of the genetic programming.
      generations: of the genetic programming.
      seed: decides everything.
      out: folder for closed_form.npz and closed_form.json; must be new or empty.
    """
    loaded = load_objective(objective)
    config = DistillConfig(
        samples=samples, population_size=population_size, generations=generations, seed=seed
    )
    _make_folder(out)
    found = distill(loaded, config)
    settings = {"samples": samples, "population-size": population_size}
    settings |= {"generations": generations, "seed": seed}
    flags = [f"--{name}={value}" for name, value in settings.items()]
    path, certificate = save_objective(
        out / "closed_form.npz",
        found.drift,
        found.parameters,
        {
            "config": {
                "distill": config,
                "of": loaded.name,
                "of_sha256": loaded.metadata.get("sha256"),
            },
            "seeds": {"distill": seed},
            "results": {"r2": found.r2, "base_r2": found.base_r2, "front": found.front},
            "cost": {"seconds": round(found.seconds, 1), "machine": machine_description()},
            # A file goes by its name: the folder it lay in is this machine's.
            "command": shlex.join(["lpo", "distill", Path(objective).name, *flags]),
        },
    )
    print(f"expression: {found.drift.expression}")
    gate = f"gate({found.drift.gate:g}) * " if found.drift.gate else ""
    print(f"drift: relu({'base + ' if found.drift.base == 'ppo' else ''}{gate}expression - xi)")
    print("R² on unseen points: " + ", ".join(f"{k} {v:.3f}" for k, v in found.r2.items()))
    base = ", ".join(f"{k} {v:.3f}" for k, v in found.base_r2.items())
    print(f"R² of the base ({found.drift.base}) alone: {base}")
    print(f"it {certificate}")
    print(f"objective: {path}")


def certify_command(objective: str) -> None:
    """Check that an objective is a drift, and lets policies move: its conditions and its slope on a dense grid.

    Learned drifts and formulas meet the conditions of mirror learning by construction; of those look at
    slope and kink. Exits with 1 where a condition fails, or where the kink may hold a policy still.

    Args:
      objective: ppo, ppo-0.3, dpo, none, a zoo name, or path.npz.
    """
    loaded = load_objective(objective)
    certificate = certify(loaded.drift, loaded.parameters)
    print(f"{loaded.name} {certificate}")
    if not certificate.holds or certificate.stalls:
        sys.exit(1)


def _named_apart(names: Sequence[str]) -> list[Objective]:
    # Every `lpo meta-train` writes an objective.npz: files of one name go by what was typed.
    loaded = [load_objective(name) for name in names]
    known = [objective.name for objective in loaded]
    loaded = [
        replace(objective, name=typed) if known.count(objective.name) > 1 else objective
        for objective, typed in zip(loaded, names, strict=True)
    ]
    check_names(loaded)
    return loaded


def _make_folder(out: Path) -> None:
    # Before the training and not after it, which may take hours.
    make_folder(out)
    if any(out.iterdir()):
        raise UserError(f"{out} already exists and is not empty: choose another --out.")
