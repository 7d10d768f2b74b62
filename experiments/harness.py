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
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from matplotlib.figure import Figure

from experiments import claims, rendering
from experiments.claims import Claim, Judged
from experiments.parts import InParts, Jobs, elsewhere
from experiments.reports import Report, complete, forget_replaced, read
from scb import plotting
from scb.cli import exit_code
from scb.command_line import flags
from scb.configurations import grown
from scb.environments.registry import families
from scb.errors import UserError
from scb.files import as_json, make_folder, write_json
from scb.locks import held
from scb.machine import machine_description, package_versions

CLASSIC_CONTROL = tuple(sorted(families()["classic"].suite))
DATA = Path("docs/data")
DOCS = Path("docs")
PLANS = Path(__file__).with_name("plans")
# How what is interrupted goes on.
AGAIN = "the same command measures what its report lacks."
Save = Callable[[], None]
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
      further: names of pages beside its own, of templates that are given the same.
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
    further: Sequence[str] = ()
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
        found = self.claims(report)
        judged = claims.judge(found)
        own = {
            "experiment": self,
            "judged": judged,
            "level": claims.confidence(found),
            "stored": any(x.stored for x in judged),
            "outcome": claims.outcome(judged),
        }
        return {**report, **own, "report": report, **self.facts(report)}

    def page(self, report: Report) -> str:
        """The page in Markdown."""
        return rendering.template(self.name).render(self.context(report))

    def pages(self, report: Report) -> dict[str, str]:
        """{name: page} of all that it has, without those of which the report tells nothing."""
        if not rendering.has_template(self.name):
            return {}
        context = self.context(report)
        made = {x: rendering.template(x).render(context) for x in (self.name, *self.further)}
        return {name: text for name, text in made.items() if text.strip()}

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
            plan = as_json(dict(self.presets[preset]))
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
        for name, page in self.pages(report).items():
            (docs / f"{name}.md").write_text(page)
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
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    except OSError as error:
        raise UserError(
            f"{command[0]} cannot be run ({error.strerror}): give a program of Python, such as FOLDER/bin/python."
        ) from error
    if done.returncode:
        raise UserError(f"an agent could not be trained: {shlex.join(command)} says why.")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def command_of(name: str, options: Any) -> str:
    """The command that measures with these options; where it writes is none of them."""
    words = shlex.join(flags(options, type(options)()))
    return f"python -m experiments {name} {words}".rstrip()
