"""The paper's experiments: what there is, and all of them in one go.

    python -m experiments --list
    python -m experiments --preset quick

The second runs every experiment of the paper with a preset, continues what was interrupted, keeps what
has the paper's size already, and writes docs/experiments.md, which says of each what the paper claims
and what was found.
"""

import argparse
import importlib
import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import page
from experiments.page import Experiment
from scb.errors import UserError
from scb.runs import make_folder


def modules() -> list[str]:
    """Names of the modules that are commands."""
    folder = Path(__file__).parent
    names = (m.name for m in pkgutil.iter_modules([str(folder)]))
    return [
        n
        for n in names
        if n not in ("__main__", "page", "rejax_peer", "searches", "zoo_table_page")
    ]


def found() -> dict[str, Experiment]:
    """{name: experiment} of the paper."""
    loaded = {name: importlib.import_module(f"experiments.{name}") for name in modules()}
    return {name: m.EXPERIMENT for name, m in loaded.items() if hasattr(m, "EXPERIMENT")}


def listing() -> str:
    """What `--list` prints."""
    experiments = found()
    lines = ["The paper's experiments (python -m experiments.NAME --preset quick|paper):", ""]
    for name, experiment in experiments.items():
        minutes = ", ".join(
            f"{p} {m} min" if m.isdigit() else f"{p} {m}" for p, m in experiment.minutes.items()
        )
        lines += [
            f"  {name}: {experiment.title}",
            f"    {experiment.paper}; on two cores {minutes}; {experiment.needs or 'needs nothing more'}",
        ]
    lines += ["", "Others (--help says what they take):", ""]
    for name in modules():
        if name not in experiments:
            document = importlib.import_module(f"experiments.{name}").__doc__ or ""
            lines.append(f"  {name}: {document.splitlines()[0]}")
    return "\n".join(lines)


def overview(experiments: Sequence[Experiment], data: Path) -> str:
    """The page with all verdicts, from the reports that there are."""
    rows, sections = [], []
    for experiment in experiments:
        path = data / f"{experiment.name}.json"
        if not path.exists():
            continue
        try:
            report = page.read(path)
        except UserError:
            sections += [f"## {experiment.title}", "", "Its report cannot be read.", ""]
            continue
        if not page.complete(report):
            sections += [f"## {experiment.title}", "", "Measured in part only.", ""]
            continue
        link = f"[{experiment.title}]({experiment.name}.md)"
        outcome = experiment.outcome(report)
        rows.append([link, experiment.paper, outcome, report["preset"]])
        sections += [
            f"## {link}",
            "",
            f"**The paper** ({experiment.paper}): {experiment.claim}",
            "",
            f"**Here** (preset {report['preset']}) it {page.said(outcome)}: "
            f"{experiment.verdict(report)}",
            "",
            f"![{experiment.title}](figures/{experiment.name}.png)",
            "",
        ]
    head = ["experiment", "in the paper", "its claim here", "preset"]
    summary = [*page.table(head, rows), ""] if rows else []
    title = ["# The paper's experiments", "", "`python -m experiments --preset quick`", ""]
    return "\n".join([*title, *summary, *sections])


def _is_whole_paper(out: Path) -> bool:

    try:
        report = page.read(out, missing_is_new=True)
    except UserError:
        return False  # the experiment says so itself
    return report.get("preset") == "paper" and page.complete(report)


def main(argv: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--list", action="store_true", help="what there is, and how long it takes")
    parser.add_argument("--preset", choices=("quick", "paper"), default="quick")
    parser.add_argument("--only-render", action="store_true", help="measure nothing")
    parser.add_argument("--data", type=Path, default=page.DATA, help="for the reports")
    parser.add_argument("--docs", type=Path, default=page.DOCS, help="for pages and figures")
    arguments = parser.parse_args(argv)
    if arguments.list:
        print(listing())
        return 0
    return page.exit_status("experiments", lambda: _all(arguments))


def _all(arguments: argparse.Namespace) -> int:

    experiments = found()
    reports = [arguments.data / f"{name}.json" for name in experiments]
    if arguments.only_render and not any(path.exists() for path in reports):
        raise UserError(f"{arguments.data} holds no report of an experiment: measure first.")
    make_folder(arguments.docs, "--docs")
    failed = []
    for name, experiment in experiments.items():
        out = arguments.data / f"{name}.json"
        if arguments.only_render and not out.exists():
            continue
        # What was measured at the paper's size is worth more than the quick preset.
        kept = arguments.preset == "quick" and _is_whole_paper(out)
        print(f"{name} ..." + (" kept: it has the paper's size" if kept else ""), flush=True)
        flags = ["--preset", arguments.preset, "--out", str(out), "--docs", str(arguments.docs)]
        if arguments.only_render or kept:
            flags.append("--only-render")
        if page.main(experiment, flags):
            failed.append(name)
    text = overview(list(experiments.values()), arguments.data)
    (arguments.docs / "experiments.md").write_text(text)
    print(f"written: {arguments.docs / 'experiments.md'}")
    return 2 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
