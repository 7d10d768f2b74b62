"""The paper's experiments: what there is, one of them, or all of them in one go.

    python -m experiments --list
    python -m experiments lemma --preset paper
    python -m experiments --preset quick

The last runs every experiment of the paper with a preset, continues what was interrupted, keeps what
has the paper's size already, and writes docs/experiments.md, which says of each what the paper claims
and what was found.
"""

import importlib
import pkgutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import tyro

from experiments import claims, harness, rendering
from experiments.harness import DATA, DOCS, Experiment, Files
from experiments.reports import complete, read
from scb import termination
from scb.cli import INTERRUPTED
from scb.errors import UserError, unknown_name
from scb.files import make_folder


@dataclass(frozen=True)
class All:
    """What all experiments of the paper are run with."""

    list: bool = False
    """what there is, and how long it takes"""
    preset: Literal["quick", "paper"] = "quick"
    """quick has fewer runs or steps than the paper"""
    only_render: bool = False
    """measure nothing"""
    data: Path = DATA
    """for the reports"""
    docs: Path = DOCS
    """for pages and figures"""


def found() -> dict[str, Experiment]:
    """{name: experiment} of all modules that have one."""
    folder = Path(__file__).parent
    names = [m.name for m in pkgutil.iter_modules([str(folder)])]
    others = [x for x in names if x != "__main__"]
    modules = (importlib.import_module(f"experiments.{name}") for name in others)
    return {m.EXPERIMENT.name: m.EXPERIMENT for m in modules if hasattr(m, "EXPERIMENT")}


def named(name: str) -> Experiment:
    """An experiment by name, of which nothing else is imported; a UserError for one that is none."""
    module: Any = None
    try:
        module = importlib.import_module(f"experiments.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"experiments.{name}":  # it is there, and what it needs is not
            raise
    if not hasattr(module, "EXPERIMENT"):
        raise unknown_name("experiment", name, found())
    return cast(Experiment, module.EXPERIMENT)


def of_the_paper() -> list[Experiment]:
    """Those with a claim of the paper."""
    return [x for x in found().values() if x.presets]


def listing() -> str:
    """What `--list` prints."""
    lines = ["The paper's experiments (python -m experiments NAME --preset quick|paper):", ""]
    for experiment in of_the_paper():
        takes = (experiment.minutes or {}).items()
        minutes = ", ".join(f"{p} {m} min" if m.isdigit() else f"{p} {m}" for p, m in takes)
        lines += [
            f"  {experiment.name}: {experiment.title}",
            f"    {experiment.paper}; on two cores {minutes}; {experiment.needs or 'needs nothing more'}",
        ]
    lines += ["", "Others (--help says what they take):", ""]
    others = [x for x in found().values() if not x.presets]
    return "\n".join(lines + [f"  {x.name}: {x.description().splitlines()[0]}" for x in others])


def overview(experiments: Sequence[Experiment], data: Path) -> str:
    """The page with all verdicts, from the reports that there are."""
    sections: list[dict[str, Any]] = []
    for experiment in experiments:
        path = data / f"{experiment.name}.json"
        if not path.exists():
            continue
        entry: dict[str, Any] = {"experiment": experiment, "outcome": ""}
        sections.append(entry)
        try:
            report = read(path, keys=experiment.keys)
        except UserError:
            entry["problem"] = "Its report cannot be read."
            continue
        if not complete(report):
            entry["problem"] = "Measured in part only."
            continue
        context = experiment.context(report)
        entry |= {
            "report": report,
            "outcome": context["outcome"],
            "judged": context["judged"],
            "refuted": sum(x.outcome == claims.FAILS for x in context["judged"]),
            "verdict": rendering.block(experiment.name, "verdict", context),
        }
    rows = [entry for entry in sections if entry["outcome"]]
    return rendering.template("experiments").render(rows=rows, sections=sections)


def _is_whole_paper(out: Path) -> bool:
    try:
        report = read(out, missing_is_new=True)
    except UserError:
        return False  # the experiment says so itself
    return report.get("preset") == "paper" and complete(report)


def main(argv: Sequence[str] | None = None) -> int:
    """The command."""
    if argv is None:  # a caller's process is the caller's
        termination.watch("experiments")
        termination.goes_on(harness.AGAIN)
    given = list(sys.argv[1:] if argv is None else argv)
    if given and not given[0].startswith("-"):
        name, *rest = given
        return harness.exit_status("experiments", lambda: named(name).main(rest))
    arguments = tyro.cli(
        tyro.conf.FlagCreatePairsOff[All],
        args=given,
        prog="python -m experiments",
        description=__doc__,
    )
    return harness.exit_status(
        "experiments", lambda: _listed() if arguments.list else _all(arguments)
    )


def _listed() -> int:
    print(listing())
    return 0


def _all(arguments: All) -> int:
    experiments = of_the_paper()
    reports = {x.name: arguments.data / f"{x.name}.json" for x in experiments}
    if arguments.only_render and not any(path.exists() for path in reports.values()):
        raise UserError(f"{arguments.data} holds no report of an experiment: measure first.")
    make_folder(arguments.docs, "--docs")
    failed = False
    for experiment in experiments:
        out = reports[experiment.name]
        if arguments.only_render and not out.exists():
            continue
        # What was measured at the paper's size is worth more than the quick preset.
        kept = arguments.preset == "quick" and _is_whole_paper(out)
        note = " kept: it has the paper's size" if kept else ""
        print(f"{experiment.name} ...{note}", flush=True)
        files = Files(out, arguments.docs, arguments.only_render or kept)
        options = experiment.options(arguments.preset)
        status = harness.exit_status(experiment.name, partial(experiment.run, options, files))
        if status == INTERRUPTED:
            return status
        failed |= bool(status)  # the others are not its fault
    (arguments.docs / "experiments.md").write_text(overview(experiments, arguments.data))
    print(f"written: {arguments.docs / 'experiments.md'}")
    return 2 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
