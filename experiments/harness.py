"""What all experiments run on: flags, a report that is continued, claims that are judged, a page from a template.

An experiment is a module with an `EXPERIMENT`; plans/NAME.toml says what the paper claims and what is run
for it. Its report is a JSON object that says what was measured, with which preset and versions, and how long
it took; page and figure are made from it alone, by templates/NAME.md.j2. What a report holds already is not
measured again, so that the same command continues an interrupted one.
"""

import importlib
import json
import shlex
import shutil
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments import claims, rendering
from experiments.claims import Claim, Judged
from experiments.parts import InParts, Jobs, elsewhere, file_name
from scb import plotting
from scb.cli import exit_code
from scb.command_line import flags
from scb.configurations import grown
from scb.environments.registry import environment_spec, families
from scb.environments.synthetic import SyntheticBandit
from scb.environments.zoo import bandit_metadata, load_bandit, zoo_names
from scb.errors import UserError
from scb.files import make_folder, write_json
from scb.machine import machine_description, package_versions
from scb.measurement import Place, as_random
from scb.rows import Rows
from scb.runs import held

CLASSIC_CONTROL = tuple(sorted(families()["classic"].suite))
DATA = Path("docs/data")
DOCS = Path("docs")
PLANS = Path(__file__).with_name("plans")
# How what is interrupted goes on.
AGAIN = "the same command measures what its report lacks."
Save = Callable[[], None]
Report = Mapping[str, Any]
Measure = Callable[[Any, dict[str, Any], Save], None]
Draw = Callable[[Report], Figure | dict[str, Figure]]
Claims = Callable[[Report], Sequence[Claim]]


@dataclass(frozen=True)
class Preset:
    """What an experiment is run with where it has presets."""

    preset: Literal["quick", "paper"] = "quick"
    """quick has fewer runs or steps than the paper"""


@dataclass(frozen=True, kw_only=True)
class Keeping:
    """What an experiment is run with that keeps agents until its report has them."""

    rows: Annotated[Path | None, tyro.conf.Fixed, tyro.conf.Suppress] = None
    """the folder for them, beside the report"""


@dataclass(frozen=True)
class Files:
    """Where an experiment reads and writes."""

    out: Path | None = None
    """the report; docs/data/NAME.json"""
    docs: Path | None = None
    """for the page and the figure; docs, or the folder of --out"""
    only_render: bool = False
    """measure nothing"""


@dataclass(frozen=True)
class Experiment:
    """A figure or table of the paper, or a study of this project's own.

    Attributes:
      name: of the module, of the template and of the files that it writes.
      title: of its page.
      measure: (plan, report, save) fills the report in, and saves after every part. The plan is the
        chosen preset's; without presets the options as they were given. One of parts, `InParts`, may be made
        by jobs elsewhere.
      draw: report -> its figure, or {file name: figure} of several; None for none.
      paper: which figure or table of Liesen et al. (2024) it is; empty for none.
      claim: what the paper says, in a sentence.
      claims: report -> the parts of that.
      presets: {"quick": {...}, "paper": {...}}; what they hold is the experiment's own.
      grows: lists or tables of a preset that may get longer: what is new is measured for a report, the rest kept.
      minutes: {preset: roughly how long it takes on two cores}.
      needs: what it needs beyond the library or keeps beside its report, in words; empty for nothing.
      facts: report -> what its template shows beside the report itself.
      extras: (report, docs) writes what the page shows beside the figure; None for nothing.
      options: a data class whose fields are its flags.
      keys: what a report holds at least.
      out: the report's place, where it is not docs/data/NAME.json.
      reports: whether it has a report; a tool has none.
      dpi: of the figures.
    """

    name: str
    title: str
    measure: Measure
    draw: Draw | None = None
    paper: str = ""
    claim: str = ""
    claims: Claims = lambda report: ()
    presets: Mapping[str, Mapping[str, Any]] | None = None
    grows: Sequence[str] = ()
    minutes: Mapping[str, str] | None = None
    needs: str = ""
    facts: Callable[[Report], Mapping[str, Any]] = lambda report: {}
    extras: Callable[[Report, Path], None] | None = None
    options: type = Preset
    keys: Sequence[str] = ()
    out: Path | None = None
    reports: bool = True
    dpi: int = plotting.DPI

    @classmethod
    def of_the_paper(
        cls, name: str, measure: Measure, draw: Draw, claims: Claims, **parts: Any
    ) -> "Experiment":
        """One whose title, claim, needs and presets are those of plans/NAME.toml; presets.both is part of either."""
        said = plan_of(name)
        both = said["presets"].pop("both", {})
        said["presets"] = {preset: both | own for preset, own in said["presets"].items()}
        return cls(name, measure=measure, draw=draw, claims=claims, **said, **parts)

    def judged(self, report: Report) -> list[Judged]:
        """What becomes of each part of the claim."""
        return claims.judge(self.claims(report))

    def context(self, report: Report) -> dict[str, Any]:
        """What its template is rendered with."""
        judged = self.judged(report)
        own = {
            "experiment": self,
            "judged": judged,
            "level": claims.confidence(self.claims(report)),
            "stored": any(x.stored for x in judged),
            "outcome": claims.outcome(judged),
        }
        return {**report, **own, "report": report, **self.facts(report)}

    def page(self, report: Report) -> str:
        """The page in Markdown."""
        return rendering.template(self.name).render(self.context(report))

    def block(self, part: str, report: Report) -> str:
        """A part of the page: its verdict, its body."""
        return rendering.block(self.name, part, self.context(report))

    def figures(self, report: Report) -> dict[str, Figure]:
        """{file name: figure}."""
        with plotting.figure_style():
            drawn = {} if self.draw is None else self.draw(report)
        return drawn if isinstance(drawn, dict) else {self.name: drawn}

    def main(self, argv: Sequence[str] | None = None) -> int:
        """The command line.

        Returns:
          The exit status: 2 where the user asked for what cannot be, with one sentence on stderr.
        """
        return exit_status(self.name, lambda: self._command(argv))

    def _command(self, argv: Sequence[str] | None) -> int:
        parts: list[tuple[str, Any] | tuple[str, Any, Any]] = [
            ("options", self.options),
            ("files", Files, field(default=Files())),
        ]
        if isinstance(self.measure, InParts):
            parts.append(("jobs", Jobs, field(default=Jobs())))
        # Options that cannot be are refused as they are made.
        arguments: Any = tyro.cli(
            make_dataclass("Flags", parts),
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
            args=argv,
            prog=f"python -m experiments {self.name}",
            description=self.description(),
        )
        return self.run(arguments.options, arguments.files, getattr(arguments, "jobs", Jobs()))

    def description(self) -> str:
        """What --help says: of the paper's claim, or the module's docstring."""
        if self.paper:
            return f"{self.title}. The paper ({self.paper}): {self.claim}"
        return importlib.import_module(f"experiments.{self.name}").__doc__ or ""

    def run(self, options: Any, files: Files, jobs: Jobs = Jobs()) -> int:  # noqa: B008
        """Measures what is missing, and writes page and figure."""
        if not self.reports:
            self.measure(options, {}, lambda: None)
            return 0
        out = files.out or self.out or DATA / f"{self.name}.json"
        # What is measured elsewhere leaves the documentation's page as it is.
        docs = files.docs or (DOCS if files.out is None else out.parent)
        make_folder(docs, "--docs" if files.docs or files.out is None else "--out")
        if not files.only_render:
            make_folder(out.parent)
        # Two that measure would each save what they have, and not what the other has.
        with nullcontext() if files.only_render else held(out):
            # One that was interrupted lacks some, and goes on.
            needed = self.keys if files.only_render else ()
            report = read(out, missing_is_new=not files.only_render, keys=needed)
            if report and report.get("experiment") != self.name:
                raise UserError(
                    f"{out} is no report of {self.name}: choose another --out, or of all experiments --data."
                )
            if not files.only_render:
                self._measure(options, report, out, jobs)
        self.render(report, docs)
        return 0

    def _measure(self, options: Any, report: dict[str, Any], out: Path, jobs: Jobs) -> None:
        plan: dict[str, Any] = {}
        fixed: dict[str, Any] = {}
        if self.presets:
            preset = options.preset
            if report.get("preset", preset) != preset:
                raise UserError(
                    f"{out} holds the preset {report['preset']}: choose another --out for the preset {preset}, beside "
                    "which its page is then written; of all experiments another --data and --docs."
                )
            plan = json.loads(json.dumps(dict(self.presets[preset])))
            stored = report.get("plan", plan)
            more = {x: plan[x] for x in self.grows if grown(stored.get(x), plan[x])}
            if {**stored, **more} != plan:
                raise UserError(
                    f"{out} was measured when the preset {preset} was another one: choose another --out, or of all "
                    "experiments --data."
                )
            fixed = {"preset": preset, "plan": plan, "complete": False}
            forget_replaced(report)
        before, start = report.get("seconds", 0.0), time.monotonic()
        # What measures nothing leaves the report to the machine that made it.
        here = {"versions": package_versions(), "machine": machine_description()}
        report |= {"experiment": self.name, **fixed}
        began = saved = json.dumps(report)

        def save() -> None:
            nonlocal saved
            if json.dumps(report) == saved:
                return
            report.update(here, seconds=round(before + time.monotonic() - start, 1))
            write_json(out, report)
            saved = json.dumps(report)

        further = {k: v for k, v in asdict(options).items() if k != "preset"}
        # Where a measurement may keep its agents until its part of the report is saved.
        rows = out.with_suffix(".rows")
        given = options
        if self.presets:
            given = {**plan, **further, "rows": rows}
        elif isinstance(options, Keeping):
            given = replace(options, rows=rows)
        if isinstance(self.measure, InParts) and jobs.executor != "here":
            kept = out.with_suffix(".parts")
            elsewhere(
                self.measure.parts(given, report), report, save, jobs, kept, settings=str(given)
            )
            shutil.rmtree(kept)
        else:
            self.measure(given, report, save)
        if json.dumps(report) == began:
            print(f"{self.name}: {out} has all that is asked for already.")
        if self.presets:
            report["complete"] = True
        write_json(out, report)
        shutil.rmtree(rows, ignore_errors=True)

    def render(self, report: Report, docs: Path) -> None:
        """Writes docs/NAME.md and docs/figures/NAME.png.

        Raises:
          UserError: the report is not complete.
        """
        if self.presets and not complete(report):
            raise UserError(
                f"the report of {self.name} is not complete: leave out --only-render, with --preset "
                f"{report.get('preset', 'quick')}, and the command goes on where it was."
            )
        if rendering.has_template(self.name):
            (docs / f"{self.name}.md").write_text(self.page(report))
        for name, figure in self.figures(report).items():
            plotting.save(figure, docs / "figures" / f"{name}.png", self.dpi)
        if self.extras is not None:
            self.extras(report, docs)


def plan_of(name: str) -> dict[str, Any]:
    """What plans/NAME.toml says."""
    return tomllib.loads((PLANS / f"{name}.toml").read_text())


def exit_status(name: str, command: Callable[[], int]) -> int:
    """What a command returns, or what it is where it fails for a reason that a user can see to, with a sentence."""
    return exit_code(name, command, AGAIN)


def last_line(command: Sequence[str]) -> dict[str, Any]:
    """What a process prints at its end, as JSON.

    Raises:
      UserError: it failed; what it said of that is on stderr.
    """
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise UserError(f"an agent could not be trained: {shlex.join(command)} says why.")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def complete(report: Report) -> bool:
    """Whether everything that the report is about was measured."""
    return bool(report.get("complete"))


def read(path: Path, missing_is_new: bool = False, keys: Iterable[str] = ()) -> dict[str, Any]:
    """A report from its file, with these keys at least; a UserError where there is none."""
    if missing_is_new and not path.exists():
        return {}
    try:
        report: Any = json.loads(path.read_text())
        if not isinstance(report, dict):
            raise ValueError("it is no JSON object")
        if lacking := [key for key in keys if key not in report]:
            raise ValueError(f"it lacks {', '.join(lacking)}")
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} is no report of this command ({error}): measure first, or choose another --out."
        ) from error
    return report


def command_of(name: str, options: Any) -> str:
    """The command that measures with these options; where it writes is none of them."""
    words = shlex.join(flags(options, type(options)()))
    return f"python -m experiments {name} {words}".rstrip()


def settled(report: dict[str, Any], **settings: Any) -> None:
    """Notes in a report what it is measured with.

    Raises:
      UserError: what it holds was measured with something else.
    """
    for name, value in settings.items():
        value = json.loads(json.dumps(value))
        if report.setdefault(name, value) != value:
            raise UserError(
                f"the report holds what was measured with {name} {report[name]}, and {value} is asked for: choose "
                "another --out."
            )


def bandit_of(environment: str) -> tuple[SyntheticBandit, str]:
    """The zoo's bandit of an environment, and the checksum of its weights."""
    name = environment_spec(environment).bandit
    return load_bandit(name), bandit_metadata(name)["sha256"]


def forget_replaced(report: dict[str, Any]) -> None:
    """Takes out of a report what is of bandits that the zoo has replaced since, so that it is measured again.

    An entry's "sha256" says which bandit it is of; "published" ends the names of entries of other people's. None
    keeps the entry's place.
    """
    ours = {bandit_metadata(name)["sha256"] for name in zoo_names()}

    def replaced(entry: Any) -> bool:
        digest = entry.get("sha256") if isinstance(entry, dict) else None
        return isinstance(digest, str) and digest not in ours

    def forget(tree: dict[str, Any]) -> None:
        for name, entry in tree.items():
            if name.endswith("published"):
                continue
            if replaced(entry):
                tree[name] = None
            elif isinstance(entry, dict):
                forget(entry)

    if replaced(report):
        report.clear()
    forget(report)


def forget_other(entries: dict[str, Any], name: str, digest: str, of: str = "sha256") -> None:
    """Takes out an entry that is of another bandit, or objective, than the one with this checksum; `of` is its key."""
    if name in entries and entries[name].get(of) != digest:
        del entries[name]


def rows_in(folder: Path | None, *names: str) -> Rows:
    """Where agents of this name are kept until the report has them: in a file of the folder, or in memory."""
    return Rows(folder and folder / f"{file_name(*names)}.jsonl")


def lost(report: Any, of_them: bool = False) -> int:
    """How many agents of a report, or of a part of it, earned no number: what is under "failed", at any depth."""
    if isinstance(report, Mapping):
        return sum(lost(x, of_them or name == "failed") for name, x in report.items())
    return report if of_them else 0


def finite(returns: Any, place: Place) -> tuple[list[float], int]:
    """([N] returns to two digits, how many were no number): those count as random actions there."""
    values, failed = as_random(np.asarray(returns, np.float64), place)
    return np.round(values, 2).tolist(), int(failed.sum())
