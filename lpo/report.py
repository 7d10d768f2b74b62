"""The report of a run: one HTML file that needs nothing else.

The page opens with the one number that matters, says in words what its interval allows to say, and
goes on to what is needed to doubt it: protocol, cost, certificate, seeds, versions and the command.
"""

import base64
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import jinja2

from lpo.certificate import LARGEST_KINK, Certificate
from scb.errors import UserError
from scb.plotting import ratio_text, thousands

if TYPE_CHECKING:
    pass

SCHEMA_VERSION = 1

Verdict = Literal["better", "worse", "undecided", "one seed", "not compared"]

# Below this many seeds the bootstrap's intervals are too narrow (see `scb.statistics`).
_FEW_SEEDS = 10
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_OWN_FIGURES = ("meta_training", "environment_steps", "drift_heatmaps")
_NAMES = {"ppo": "PPO's clip"}


@dataclass(frozen=True)
class Headline:
    """What a run found, in one sentence.

    Attributes:
      verdict: what the interval of the difference allows to say.
      before, number, after: the sentence in three parts, so that a page can stress the number.
    """

    verdict: Verdict
    before: str
    number: str = ""
    after: str = ""

    def __str__(self) -> str:
        return f"{self.before}{self.number}{self.after}"


def headline(results: Mapping[str, Any]) -> Headline:
    """The difference between the learned objective and the reference, where it was learned for.

    That is the meta-training's environment, or the one that its bandit stands for; without a
    comparison there, the first comparison that holds the objective.

    Args:
      results: as in `write_report`.
    """
    name = results["objective"]["name"]
    comparisons = results["comparisons"]
    home = results.get("meta_training", {}).get("evaluation_environment")
    for environment in [e for e in (home, *comparisons) if e in comparisons]:
        comparison = comparisons[environment]
        if name in comparison["paired_differences"]:
            return _sentence(name, environment, comparison)
    return Headline("not compared", f"{name} was compared with no other objective.")


def write_report(folder: Path, results: Mapping[str, Any], figures: Mapping[str, Path]) -> Path:
    """Writes folder/report.html: images and style inside, no script, nothing loaded from elsewhere.

    Equal input gives equal bytes.

    Args:
      folder: must exist.
      results: plain JSON types:
        schema_version: 1.
        preset, command: strings; the command reproduces the run.
        versions, machine: {name: text}.
        seconds: wall-clock of the whole run.
        objective: {"name", "certificate": `Certificate.as_dict()`}; the certificate is optional.
        meta_training (optional): {"environment", "evaluation_environment", "config" (nested), "seconds", "generations",
          "steps": {"training", "evaluation", "total"} of all candidates, "environment_steps":
          the same for meta-training on the environment itself (optional)}.
        comparisons: {environment: `Comparison.as_dict()`}.
      figures: PNG files by the function that drew them ("meta_training" for the curve,
        "environment_steps", "drift_heatmaps"), and learning curves by their environment, as in
        `comparisons`. Any may be missing; others are shown at the end under their name.

    Returns:
      The path of the page.

    Raises:
      UserError: another schema version, a missing part of `results`, or a figure that is no PNG.
    """
    version = results.get("schema_version")
    if version != SCHEMA_VERSION:
        raise UserError(
            f"the results have schema version {version}, this version reads {SCHEMA_VERSION}: "
            "write the report with the version that made them, or run again."
        )
    missing = [key for key in ("objective", "comparisons") if key not in results]
    if missing:
        raise UserError(
            f"the results lack {' and '.join(missing)}: a report shows an objective and its "
            "comparisons, so run both first."
        )
    page = _environment().get_template("report.html.j2").render(_context(results, figures))
    path = Path(folder) / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _sentence(name: str, environment: str, comparison: Mapping[str, Any]) -> Headline:
    difference = comparison["paired_differences"][name]
    reference = _NAMES.get(comparison["reference"], comparison["reference"])
    verdict = _verdict(difference)
    openings = {
        "better": f"{name} ends better than {reference} on {environment}",
        "worse": f"{name} ends worse than {reference} on {environment}",
        "undecided": f"No difference between {name} and {reference} could be shown on "
        f"{environment}",
        "one seed": f"One seed cannot tell {name} from {reference} on {environment}",
    }
    protocols = {
        "one seed": "a single seed, so no interval",
        "undecided": f"{difference['n']} paired seeds; the 95 % interval includes zero",
    }
    protocol = protocols.get(verdict, f"{difference['n']} paired seeds, 95 % interval")
    return Headline(
        verdict,
        f"{openings[verdict]}: the difference in final return is ",
        _interval(difference, signed=True),
        f" ({name} minus {comparison['reference']}; interquartile means of {protocol}).",
    )


def _verdict(difference: Mapping[str, Any]) -> Verdict:
    if difference["low"] is None or difference["high"] is None:
        return "one seed"
    if difference["low"] > 0:
        return "better"
    return "worse" if difference["high"] < 0 else "undecided"


def _columns(reference: str) -> dict[str, str]:
    return {
        "objective": "objective",
        "final": "final return, IQM [95 %]",
        "area": "area under curve, IQM [95 %]",
        "difference": f"difference to {reference} [95 %]",
        "n": "seeds",
        "episodes": "episodes",
        "backend": "physics",
        "actions": "actions",
    }


def _rows(comparison: Mapping[str, Any], learned: str | None) -> list[dict[str, Any]]:
    rows = []
    for curve in comparison["curves"]:
        name = curve["objective"]
        difference = comparison["paired_differences"].get(name)
        cells = {
            "objective": name,
            "final": _interval(curve["final_iqm"]),
            "area": _interval(curve["area_iqm"]),
            "difference": "reference" if difference is None else _interval(difference, signed=True),
            "n": str(len(curve["seeds"])),
            "episodes": str(curve["episodes"]),
            "backend": curve["backend"] or "–",
            "actions": "mode" if curve["mode_actions"] else "sampled",
        }
        verdict = "" if difference is None else _verdict(difference)
        rows.append({"cells": cells, "verdict": verdict, "learned": name == learned})
    return rows


def _interval(estimate: Mapping[str, Any], signed: bool = False) -> str:
    # -147 [-162, -126]: as many places as the width of the interval gives meaning to.
    value, low, high = estimate["value"], estimate["low"], estimate["high"]
    if low is None or high is None:
        return f"{_number(value, _places(abs(value), 4), signed)} [no interval]"
    places = _places((high - low) / 2, 2) if high > low else _places(abs(value), 4)
    # An end that is not zero must not be printed as zero: the verdict hangs on its sign.
    while places < 6 and any(end != 0 and round(end, places) == 0 for end in (low, high)):
        places += 1
    value, low, high = (_number(x, places, signed) for x in (value, low, high))
    return f"{value} [{low}, {high}]"


def _places(size: float, digits: int) -> int:
    return max(0, digits - 1 - math.floor(math.log10(size))) if size > 0 else 1


def _number(x: float, places: int, signed: bool = False) -> str:
    text = f"{x:+.{places}f}" if signed else f"{x:.{places}f}"
    # A sign before nothing but zeros is noise; the minus is the typographic one, which no line
    # break separates from its number.
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("+-")
    return text.replace("-", "−")


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def _seeds(seeds: Sequence[int]) -> str:
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(str(seed) for seed in seeds)


def _flatten(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """{"evolution": {"seed": 0}} -> ("evolution.seed", "0"); things in a list are numbered."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flatten(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        for index, item in enumerate(value, start=1):
            yield from _flatten(item, f"{name}.{index}")
    elif isinstance(value, list | tuple):
        yield name, ", ".join(str(item) for item in value)
    else:
        yield name, "–" if value is None else str(value)


def _embed(path: Path) -> dict[str, Any]:
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(
            f"cannot read the figure {path} ({error.strerror}): save it before writing the report."
        ) from error
    if not data.startswith(_PNG_SIGNATURE) or len(data) < 24:
        raise UserError(f"{path} is no PNG: save figures with scb.plotting.save.")
    width, height = struct.unpack(">II", data[16:24])
    encoded = base64.b64encode(data).decode("ascii")
    return {"source": f"data:image/png;base64,{encoded}", "width": width, "height": height}


def _certificate_rows(certificate: Mapping[str, Any]) -> list[dict[str, Any]]:
    def row(condition: str, measured: str, required: str, holds: bool | None) -> dict[str, Any]:
        return {"condition": condition, "measured": measured, "required": required, "holds": holds}

    minimum, value = certificate["minimum"], certificate["value_at_one"]
    gradient, finite = certificate["gradient_at_one"], certificate["finite"]
    near, further = certificate["slope_at_0_001"], certificate["slope_at_0_01"]
    return [
        row("smallest penalty f", f"{minimum:.3g}", "≥ 0", minimum >= 0),
        row("largest |f| at ratio 1", f"{value:.3g}", "0", value == 0),
        row("largest |df/dr| at ratio 1", f"{gradient:.3g}", "0", gradient == 0),
        row("finite everywhere", "yes" if finite else "no", "yes", bool(finite)),
        row("largest |df/dr| at |r − 1| = 0.001", f"{near:.3g}", "no condition", None),
        row("largest |df/dr| at |r − 1| = 0.01", f"{further:.3g}", "no condition", None),
        row(
            "kink: mean rise of f around ratio 1",
            f"{certificate['kink']:.3g}",
            f"≤ {LARGEST_KINK}, or none at |r − 1| = 0.001",
            not Certificate(**certificate).stalls,
        ),
    ]


def _meta_training(meta: Mapping[str, Any]) -> dict[str, Any]:
    steps, other = meta["steps"], meta.get("environment_steps")
    rows = [
        {
            "what": kind,
            "here": thousands(steps[kind]),
            "there": thousands(other[kind]) if other else "",
            "ratio": ratio_text(steps[kind], other[kind]) if other else "",
        }
        for kind in ("training", "evaluation", "total")
    ]
    return {
        "environment": meta["environment"],
        "home": meta["evaluation_environment"],
        "generations": meta["generations"],
        "duration": _duration(meta["seconds"]),
        "total": thousands(steps["total"]),
        "config": list(_flatten(meta["config"])),
        "rows": rows,
        "compared": other is not None,
    }


def _comparison(name: str, comparison: Mapping[str, Any], learned: str) -> dict[str, Any]:
    curves = comparison["curves"]
    return {
        "name": name,
        "columns": _columns(comparison["reference"]),
        "rows": _rows(comparison, learned),
        "seeds": _seeds(curves[0]["seeds"]),
        "steps": thousands(max(curve["steps"][-1] for curve in curves)),
        "few_seeds": min(len(curve["seeds"]) for curve in curves) < _FEW_SEEDS,
        "backend": curves[0]["backend"],
    }


def _elsewhere(results: Mapping[str, Any], said: Headline) -> list[Headline]:
    # The headline must not hide where the objective did worse.
    name = results["objective"]["name"]
    sentences = [
        _sentence(name, environment, comparison)
        for environment, comparison in results["comparisons"].items()
        if name in comparison["paired_differences"]
    ]
    return [sentence for sentence in sentences if sentence != said]


def _context(results: Mapping[str, Any], figures: Mapping[str, Path]) -> dict[str, Any]:
    objective = results["objective"]
    certificate = objective.get("certificate")
    comparisons = results["comparisons"]
    meta = results.get("meta_training")
    embedded = {name: _embed(path) for name, path in figures.items()}
    first = headline(results)
    known = {*_OWN_FIGURES, *comparisons}
    return {
        "name": objective["name"],
        "preset": results.get("preset"),
        "headline": first,
        "elsewhere": _elsewhere(results, first),
        "comparisons": [
            _comparison(name, comparison, objective["name"])
            for name, comparison in comparisons.items()
        ],
        "meta": _meta_training(meta) if meta else None,
        "certificate": Certificate(**certificate) if certificate else None,
        "certificate_rows": _certificate_rows(certificate) if certificate else [],
        "figures": embedded,
        "further": [name for name in embedded if name not in known],
        "command": results.get("command"),
        "duration": _duration(results["seconds"]) if "seconds" in results else None,
        "tables": {
            name: list(_flatten(results[name]))
            for name in ("versions", "machine")
            if results.get(name)
        },
    }


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,  # names come from files and command lines
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    # A line must not end between a number and its per cent sign.
    environment.filters["unbroken"] = lambda text: text.replace(" %", "\N{NO-BREAK SPACE}%")
    return environment
