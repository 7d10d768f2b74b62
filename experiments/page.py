"""What the paper's experiments share: presets, a report that is continued, and a page of one form.

An experiment is a module with an `EXPERIMENT`, which `main` runs. Its report is a JSON object that says
what was measured, with which preset and versions, and how long it took; page and figure are made
from it alone. What a report holds already is not measured again, so that the same command continues
an interrupted one.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from scb import plotting
from scb.artefacts import machine_description, package_versions
from scb.cli import configure_jax
from scb.errors import UserError
from scb.runs import make_folder, write_json
from scb.statistics import Estimate

DATA = Path("docs/data")
DOCS = Path("docs")
CLASSIC_CONTROL = (
    "Acrobot-v1",
    "CartPole-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
)
# What the actions of each are.
ACTIONS = {
    "Acrobot-v1": "torque on joint 2, \u22121, 0, 1",
    "CartPole-v1": "push left, right",
    "MountainCar-v0": "push left, none, right",
    "MountainCarContinuous-v0": "force (of its maximum)",
    "Pendulum-v1": "torque (N m)",
}
Save = Callable[[], None]
# What becomes of a claim.
HOLDS, IN_PART, FAILS, UNTESTED = (
    "holds",
    "holds in part",
    "does not hold",
    "not tested at this size",
)


@dataclass(frozen=True)
class Experiment:
    """A figure or table of the paper.

    Attributes:
      name: of the module and of the files that it writes.
      title: of its page.
      paper: which figure or table of Liesen et al. (2024) it is.
      claim: what the paper says, in a sentence.
      presets: {"quick": {...}, "paper": {...}}; what they hold is the experiment's own.
      minutes: {preset: roughly how long it takes on two cores}.
      needs: what it needs beyond the library or keeps beside its report, in words; empty for nothing.
      measure: (plan, report, save) fills the report in, and saves after every part.
      parts: report -> whether each part of the claim holds here; None where the report cannot tell.
      verdict: report -> how the claim's parts fare, in a few sentences with figures.
      body: report -> the lines of the page below the figure.
      draw: report -> the figure.
      extras: (report, docs) writes what the page shows beside the figure; None for nothing.
    """

    name: str
    title: str
    paper: str
    claim: str
    presets: Mapping[str, Mapping[str, Any]]
    minutes: Mapping[str, str]
    measure: Callable[[Mapping[str, Any], dict[str, Any], Save], None]
    parts: Callable[[Mapping[str, Any]], Sequence[bool | None]]
    verdict: Callable[[Mapping[str, Any]], str]
    body: Callable[[Mapping[str, Any]], list[str]]
    draw: Callable[[Mapping[str, Any]], Figure]
    needs: str = ""
    extras: Callable[[Mapping[str, Any], Path], None] | None = None

    def outcome(self, report: Mapping[str, Any]) -> str:
        """Whether the claim holds here: one of four."""
        parts = self.parts(report)
        told = [part for part in parts if part is not None]
        if not told:
            return UNTESTED
        if not any(told):
            return FAILS
        return HOLDS if all(told) and len(told) == len(parts) else IN_PART


def said(outcome: str) -> str:
    """With its verb, as in "it holds", "it is not tested at this size"."""
    return f"is *{outcome}*" if outcome == UNTESTED else f"*{outcome}*"


def page(experiment: Experiment, report: Mapping[str, Any]) -> str:
    """The page in Markdown: the paper's claim, ours, the figure, the tables, how it was measured."""
    machine, versions = report["machine"], report["versions"]
    note = ""
    if report["preset"] == "quick":
        note = " The quick preset has fewer runs or steps than the paper."
    lines = [
        f"# {experiment.title}",
        "",
        f"`python -m experiments.{experiment.name} --preset {report['preset']}`",
        "",
        f"**The paper** ({experiment.paper}): {experiment.claim}",
        "",
        f"**Here** it {said(experiment.outcome(report))}: {experiment.verdict(report)}",
        "",
        f"![{experiment.title}](figures/{experiment.name}.png)",
        "",
        *experiment.body(report),
        "",
        f"Preset `{report['preset']}`.{note} Measured in {report['seconds'] / 60:.1f} minutes on "
        f"{machine['cores']} cores, {machine['processor']}, accelerator: {machine['accelerator']}; "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + ".",
        "",
    ]
    return "\n".join(lines)


def packed(rows: Any) -> list[str]:
    """[N, M] numbers as a line of JSON a row; one number a line would make a report unreadable."""
    return [" ".join(f"{x:.4g}" for x in row) for row in rows]


def unpacked(lines: Sequence[str]) -> NDArray[np.floating]:
    """What `packed` packed, to four digits."""
    return np.array([[float(x) for x in line.split()] for line in lines])


def finite(returns: Any, instead: float) -> tuple[list[float], int]:
    """([N] returns to two digits, how many were no number): those count as `instead`, the return of random actions."""
    values = np.asarray(returns, np.float64)
    bad = ~np.isfinite(values)
    return np.round(np.where(bad, instead, values), 2).tolist(), int(bad.sum())


def run_name(file: Path) -> str:
    """What to call an objective's file: every run's is objective.npz, and its folder tells runs apart."""
    return file.parent.name if file.stem == "objective" else file.stem


def span(numbers: Iterable[int]) -> str:
    """Such as "30 to 60", or "30" where all are alike."""
    low, high = min(found := list(numbers)), max(found)
    return str(low) if low == high else f"{low} to {high}"


def text(estimate: Estimate | Mapping[str, Any], places: int = 0, sign: bool = False) -> str:
    """An estimate with its interval, with a real minus sign."""
    values = estimate if isinstance(estimate, Mapping) else estimate.as_dict()
    value = f"{values['value']:{'+' if sign else ''}.{places}f}"
    if values["low"] is not None:
        value += f" [{values['low']:.{places}f}, {values['high']:.{places}f}]"
    return value.replace("-", "\u2212")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    return [
        f"| {' | '.join(head)} |",
        "| " + " | ".join("---" for _ in head) + " |",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def main(experiment: Experiment, argv: Sequence[str] | None = None) -> int:
    """The command line of an experiment.

    Returns:
      The exit status: 2 where the user asked for what cannot be, with one sentence on stderr.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{experiment.name}",
        description=f"{experiment.title}. The paper ({experiment.paper}): {experiment.claim}",
    )
    parser.add_argument("--preset", choices=sorted(experiment.presets), default="quick")
    parser.add_argument("--out", type=Path, help="the report; docs/data/NAME.json")
    parser.add_argument(
        "--docs", type=Path, help="for the page and the figure; docs, or the folder of --out"
    )
    parser.add_argument("--only-render", action="store_true", help="measure nothing")
    arguments = parser.parse_args(argv)
    configure_jax()

    out = DATA / f"{experiment.name}.json" if arguments.out is None else arguments.out
    docs = arguments.docs
    if docs is None:
        # What is measured elsewhere leaves the documentation's page as it is.
        docs = DOCS if arguments.out is None else out.parent

    def measure_and_render() -> int:

        make_folder(docs, "--docs")
        report = read(out, missing_is_new=not arguments.only_render)
        if report and report.get("experiment") != experiment.name:
            raise UserError(f"{out} is no report of {experiment.name}: choose another --out.")
        if not arguments.only_render:
            make_folder(out.parent)
            _measure(experiment, arguments.preset, report, out)
        render(experiment, report, docs)
        return 0

    return exit_status(experiment.name, measure_and_render)


def exit_status(name: str, command: Callable[[], int]) -> int:
    """What a command returns; 2 where it raises a UserError, whose sentence goes to stderr behind the name."""
    try:
        return command()
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2


def render(experiment: Experiment, report: Mapping[str, Any], docs: Path) -> None:
    """Writes docs/NAME.md and docs/figures/NAME.png.

    Raises:
      UserError: the report is not complete.
    """
    if not complete(report):
        raise UserError(
            f"the report of {experiment.name} is not complete: run python -m experiments.{experiment.name} "
            f"--preset {report.get('preset', 'quick')}, which goes on where it was."
        )

    (docs / f"{experiment.name}.md").write_text(page(experiment, report))
    plotting.save(experiment.draw(report), docs / "figures" / f"{experiment.name}.png")
    if experiment.extras is not None:
        experiment.extras(report, docs)


def complete(report: Mapping[str, Any]) -> bool:
    """Whether everything that the report is about was measured."""
    return bool(report.get("complete"))


def _measure(experiment: Experiment, preset: str, report: dict[str, Any], out: Path) -> None:

    if report.get("preset", preset) != preset:
        raise UserError(
            f"{out} holds the preset {report['preset']}: choose another --out for the preset {preset}; "
            "its page is then written beside it."
        )
    plan = json.loads(json.dumps(dict(experiment.presets[preset])))
    if report.get("plan", plan) != plan:
        raise UserError(
            f"{out} was measured when the preset {preset} was another one: choose another --out."
        )
    before, start = report.get("seconds", 0.0), time.monotonic()
    # What measures nothing leaves the report to the machine that made it.
    here = {"versions": package_versions(), "machine": machine_description()}
    report |= {"experiment": experiment.name, "preset": preset, "plan": plan, "complete": False}

    def save() -> None:
        report.update(here, seconds=round(before + time.monotonic() - start, 1))
        write_json(out, report)

    experiment.measure(plan, report, save)
    report["complete"] = True
    write_json(out, report)


def read(path: Path, missing_is_new: bool = False, keys: Iterable[str] = ()) -> dict[str, Any]:
    """A report from its file, with these keys at least; a UserError where there is none."""
    if missing_is_new and not path.exists():
        return {}
    try:
        report = dict(json.loads(path.read_text()))
        if lacking := [key for key in keys if key not in report]:
            raise ValueError(f"it lacks {', '.join(lacking)}")
    except (OSError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is no report of this command ({error}): measure first, or choose another --out."
        ) from error
    return report
