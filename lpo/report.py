"""The report of a run: one HTML file that needs nothing else.

The page opens with the one number that matters, says in words what its interval allows to say, and
goes on to what is needed to doubt it: protocol, cost, certificate, seeds, versions and the command.
"""

import base64
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jinja2

from lpo.certificate import LARGEST_KINK, Certificate
from scb.plotting import ratio_text, thousands
from scb.statistics import DECIDING, Estimate, places_apart, places_of, typeset

Verdict = Literal["better", "worse", "undecided", "few seeds", "not compared"]

_NAMES = {"ppo": "PPO's clip"}
_VERDICTS: dict[int, Verdict] = {1: "better", 0: "undecided", -1: "worse"}


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


def headlines(results: Mapping[str, Any]) -> list[Headline]:
    """The differences between the learned objective and the references; first where it was learned for.

    That is the meta-training's environment, or the one that its bandit stands for; without a
    comparison there, the first comparison that holds the objective. The rest must not be hidden.

    Args:
      results: as in `write_report`.
    """
    name = results["objective"]["name"]
    compared = {
        environment: _sentence(name, environment, comparison)
        for environment, comparison in results["comparisons"].items()
        if name in comparison["paired_differences"]
    }
    home = results["meta_training"].get("evaluation_environment")
    first = [compared.pop(home)] if home in compared else []
    said = [*first, *compared.values()]
    return said or [Headline("not compared", f"{name} was compared with no other objective.")]


def write_report(folder: Path, results: Mapping[str, Any], figures: Mapping[str, Path]) -> Path:
    """Writes folder/report.html: images and style inside, no script, nothing loaded from elsewhere.

    Equal input gives equal bytes.

    Args:
      folder: must exist.
      results: plain JSON types:
        preset, command: strings; the command reproduces the run.
        versions, machine: {name: text}.
        seconds: wall-clock of the whole run (optional).
        objective: {"name", "certificate": `Certificate.as_dict()`}.
        meta_training: {"environment", "evaluation_environment", "config" (nested), "seconds", "generations",
          "steps": {"training", "evaluation", "total"} of all candidates, "environment_steps":
          the same for meta-training on the environment itself}; empty where nothing was learned.
        comparisons: {environment: `Comparison.as_dict()`}.
        full_size: the same for what the library ships of longer trainings there (optional).
      figures: PNG files by the function that drew them ("meta_training" for the curve,
        "environment_steps", "drift_and_gradient"), and learning curves by their environment, as in
        `comparisons`, with "_full_size" behind it for those. Any may be missing.

    Returns:
      The path of the page.
    """
    page = _environment().get_template("report.html.j2").render(_context(results, figures))
    path = Path(folder) / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _sentence(name: str, environment: str, comparison: Mapping[str, Any]) -> Headline:
    difference = comparison["paired_differences"][name]
    reference = _NAMES.get(comparison["reference"], comparison["reference"])
    verdict = _verdict(difference)
    number = difference["n"]
    seeds = "a single seed" if number == 1 else f"{number} paired seeds"
    few = "One seed" if number == 1 else f"{number} seeds"
    opening, protocol = {
        "better": (f"{name} ends better than {reference}", f"{seeds}, 95 % interval"),
        "worse": (f"{name} ends worse than {reference}", f"{seeds}, 95 % interval"),
        "undecided": (
            f"No difference between {name} and {reference} could be shown",
            f"{seeds}; the 95 % interval includes zero",
        ),
        "few seeds": (
            f"{few} cannot tell {name} from {reference}",
            seeds + ("" if difference["low"] is None else ", 95 % interval, which is too narrow"),
        ),
    }[verdict]
    return Headline(
        verdict,
        f"{opening} on {environment}: the difference in final return is ",
        _interval(difference, signed=True),
        f" ({name} minus {comparison['reference']}; interquartile means of {protocol}).",
    )


def _verdict(difference: Mapping[str, Any]) -> Verdict:
    found = Estimate(**difference)
    if found.low is None or found.n < DECIDING:
        return "few seeds"
    return _VERDICTS[found.side()]


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
        return f"{_number(value, places_of(abs(value), 4), signed)} [no interval]"
    places = places_of((high - low) / 2, 2) if high > low else places_of(abs(value), 4)
    places = places_apart(places, low, high)
    value, low, high = (_number(x, places, signed) for x in (value, low, high))
    return f"{value} [{low}, {high}]"


def _number(x: float, places: int, signed: bool = False) -> str:
    text = f"{x:+.{places}f}" if signed else f"{x:.{places}f}"
    # A sign before nothing but zeros is noise.
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("+-")
    return typeset(text)


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
    data = path.read_bytes()
    width, height = struct.unpack(">II", data[16:24])  # of a PNG
    encoded = base64.b64encode(data).decode("ascii")
    return {"source": f"data:image/png;base64,{encoded}", "width": width, "height": height}


def _certificate_rows(certificate: Mapping[str, Any]) -> list[tuple[str, str, str, bool | None]]:
    """Each a condition, what was measured, what is required, and whether it holds."""
    minimum, value = certificate["minimum"], certificate["value_at_one"]
    gradient, finite = certificate["gradient_at_one"], certificate["finite"]
    near, further = certificate["slope_at_0_001"], certificate["slope_at_0_01"]

    def condition(name: str, found: float, required: str, exactly: bool) -> Any:
        # What holds does so as far as 32 bits tell, and of one that does not the numbers are far off.
        rounded = certificate["holds"] and not exactly
        wanted = f"{required}, but for rounding" if rounded else required
        return name, f"{found:.3g}", wanted, exactly or rounded

    return [
        condition("smallest penalty f", minimum, "≥ 0", minimum >= 0),
        condition("largest |f| at ratio 1", value, "0", value == 0),
        condition("largest |df/dr| at ratio 1", gradient, "0", gradient == 0),
        ("finite everywhere", "yes" if finite else "no", "yes", bool(finite)),
        ("largest |df/dr| at |r − 1| = 0.001", f"{near:.3g}", "no condition", None),
        ("largest |df/dr| at |r − 1| = 0.01", f"{further:.3g}", "no condition", None),
        (
            "kink: mean rise of f, carried on to ratio 1",
            f"{Certificate(**certificate).deciding_kink:.3g}",
            f"≤ {LARGEST_KINK}",
            not Certificate(**certificate).stalls,
        ),
    ]


def _meta_training(meta: Mapping[str, Any]) -> dict[str, Any]:
    steps, other = meta["steps"], meta["environment_steps"]
    return {
        "environment": meta["environment"],
        "home": meta["evaluation_environment"],
        "generations": meta["generations"],
        "duration": _duration(meta["seconds"]),
        "total": thousands(steps["total"]),
        "config": list(_flatten(meta["config"])),
        "rows": [
            (
                kind,
                thousands(steps[kind]),
                thousands(other[kind]),
                ratio_text(steps[kind], other[kind]),
            )
            for kind in ("training", "evaluation", "total")
        ],
    }


def _comparison(name: str, comparison: Mapping[str, Any], learned: str) -> dict[str, Any]:
    curves = comparison["curves"]
    return {
        "name": name,
        "reference": comparison["reference"],
        "rows": _rows(comparison, learned),
        "seeds": _seeds(curves[0]["seeds"]),
        "steps": thousands(max(curve["steps"][-1] for curve in curves)),
        "backend": curves[0]["backend"],
        "standing": f"{curves[0].get('standing_still') or 0:g}",
        "moving": [_moving(c) for c in curves if c.get("above_standing_still") is not None],
        "caution": comparison.get("caution", ""),
    }


def _whole(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of trainings of full size."""
    curves = comparison["curves"]
    agents = ((curve["objective"], len(curve["seeds"])) for curve in curves)
    return {
        "steps": thousands(curves[0]["steps"][-1]),
        "backend": curves[0]["backend"],
        "agents": ", ".join(f"{name} {number}" for name, number in agents),
        "few_seeds": min(len(curve["seeds"]) for curve in curves) < DECIDING,
    }


def _moving(curve: Mapping[str, Any]) -> str:
    """How many of an objective's agents end above standing still, and how fast they all are."""
    agents = len(curve["seeds"])
    speeds = [x for x in curve.get("final_speeds", ()) if x is not None]
    speed = f", {sum(speeds) / len(speeds):.2f} m/s" if speeds else ""
    above = round(curve["above_standing_still"] * agents)
    return f"{curve['objective']} {above} of {agents}{speed}"


def _context(results: Mapping[str, Any], figures: Mapping[str, Path]) -> dict[str, Any]:
    objective, meta = results["objective"], results["meta_training"]
    first, *elsewhere = headlines(results)
    return {
        "name": objective["name"],
        "preset": results["preset"],
        "headline": first,
        "elsewhere": elsewhere,
        "comparisons": [
            _comparison(name, comparison, objective["name"])
            for name, comparison in results["comparisons"].items()
        ],
        "full_size": {name: _whole(x) for name, x in results.get("full_size", {}).items()},
        "meta": _meta_training(meta) if meta else None,
        "certificate": Certificate(**objective["certificate"]),
        "certificate_rows": _certificate_rows(objective["certificate"]),
        "figures": {name: _embed(path) for name, path in figures.items()},
        "command": results["command"],
        "duration": _duration(results["seconds"]) if "seconds" in results else None,
        "tables": {name: list(_flatten(results[name])) for name in ("versions", "machine")},
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
