"""The report of a run: one HTML file that needs nothing else, and the same table as Markdown.

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
from lpo.figures import ratio_text, thousands
from scb.errors import UserError

if TYPE_CHECKING:
    from lpo.comparison import Comparison

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


def markdown_table(comparison: "Comparison") -> str:
    """The comparison as a Markdown table, one row an objective, ending in a newline."""
    data = comparison.as_dict()
    rows = [tuple(_columns(data["reference"]).values())]
    rows += [tuple(row["cells"].values()) for row in _rows(data, learned=None)]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    # Names to the left, numbers to the right.
    lines.insert(1, "| --- |" + " ---: |" * 4 + " --- |" * (len(rows[0]) - 5))
    return "\n".join(lines) + "\n"


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
    page = _environment().from_string(_TEMPLATE).render(_context(results, figures))
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
        raise UserError(f"{path} is no PNG: save figures with lpo.plotting.save.")
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
        autoescape=True,  # names come from files and command lines
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    # A line must not end between a number and its per cent sign.
    environment.filters["unbroken"] = lambda text: text.replace(" %", "\N{NO-BREAK SPACE}%")
    return environment


_TEMPLATE = """\
{% macro figure(name, caption) %}
{% if name in figures %}
<figure>
  <div class="scroll"><img src="{{ figures[name].source }}" alt="{{ caption }}"
    width="{{ figures[name].width }}" height="{{ figures[name].height }}"></div>
  <figcaption>{{ caption }}<span class="narrow"> Scroll the figure sideways.</span></figcaption>
</figure>
{% endif %}
{% endmacro %}
{% macro pairs(rows) %}
<table class="pairs">
{% for key, value in rows %}
<tr><th scope="row">{{ key }}</th><td>{{ value }}</td></tr>
{% endfor %}
</table>
{% endmacro %}
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{{ name }}: report</title>
<style>
:root { --text: #1b1f24; --quiet: #57606a; --page: #fff; --panel: #f5f6f8; --line: #d5d9de;
  --good: #00664b; --bad: #a84300; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e8eb; --quiet: #a3abb4; --page: #15181c; --panel: #20242a; --line: #3a4048;
    --good: #4cc9a0; --bad: #ff9a5c; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 60rem; color: var(--text);
  background: var(--page); font: 1rem/1.55 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; }
h3 { font-size: 1.05rem; margin: 1.75rem 0 .5rem; }
p { max-width: 44rem; }
.quiet, figcaption { color: var(--quiet); font-size: .9rem; }
.headline { border-left: .3rem solid var(--quiet); background: var(--panel);
  padding: .9rem 1.1rem; margin: 1.25rem 0; font-size: 1.15rem; max-width: none; }
.headline.better { border-color: var(--good); }
.headline.worse { border-color: var(--bad); }
.headline strong { white-space: nowrap; }
figure { margin: 1.25rem 0; }
.scroll { overflow-x: auto; background: #fff; border: 1px solid var(--line);
  border-radius: .4rem; padding: .5rem; }
img { display: block; width: 100%; height: auto; }
figcaption { margin-top: .4rem; }
.narrow { display: none; }
table { border-collapse: collapse; font-size: .9rem; margin: .75rem 0; }
th, td { text-align: left; padding: .35rem .9rem .35rem 0; vertical-align: top;
  border-bottom: 1px solid var(--line); overflow-wrap: break-word; }
thead th { vertical-align: bottom; border-bottom-width: 2px; font-weight: 600; }
tbody th, .pairs th { font-weight: 400; }
.results { width: 100%; }
.results td, .steps td { font-variant-numeric: tabular-nums; }
.number { white-space: nowrap; }
.learned th, .learned td { font-weight: 600; }
.verdict { display: block; font-size: .8rem; font-weight: 400; color: var(--quiet); }
.verdict.better, .yes { color: var(--good); }
.verdict.worse, .no { color: var(--bad); }
.pairs th { color: var(--quiet); padding-right: 1.5rem; }
.pairs td { overflow-wrap: anywhere; }
pre { background: var(--panel); border: 1px solid var(--line); border-radius: .4rem;
  padding: .75rem; white-space: pre-wrap; font-size: .9rem; }
summary { cursor: pointer; color: var(--quiet); }
.columns { display: flex; flex-wrap: wrap; gap: 0 3rem; }
@media (max-width: 46rem) {
  .scroll img { width: 44rem; max-width: none; }
  .narrow { display: inline; }
  .stack thead { display: none; }
  .stack, .stack tbody, .stack tr, .stack th, .stack td { display: block; width: 100%; }
  .stack tr { border: 1px solid var(--line); border-radius: .4rem; padding: .5rem .75rem;
    margin: .6rem 0; }
  .stack th, .stack td { border: 0; padding: .15rem 0; }
  .stack tbody th { font-weight: 600; font-size: 1rem; }
  .stack td::before { content: attr(data-label); display: block; color: var(--quiet);
    font-weight: 400; font-size: .8rem; }
  .stack td.short { display: inline-block; width: auto; margin-right: 1.5rem; }
}
@media print { .scroll { border: 0; } details > * { display: block; } }
</style>
</head>
<body>
<header>
<h1>{{ name }}</h1>
<p class="quiet">A learned policy-optimisation objective, compared with others under PPO
{%- if preset %}; preset {{ preset }}{% endif %}
{%- if duration %}; {{ duration }} in all{% endif %}.</p>
</header>
<main>
<p class="headline {{ headline.verdict }}">{{ headline.before }}<strong>{{ headline.number -}}
</strong>{{ headline.after | unbroken }}</p>
{% if elsewhere %}
<p>Elsewhere:</p>
<ul>
{% for other in elsewhere %}
<li>{{ other | string | unbroken }}</li>
{% endfor %}
</ul>
{% endif %}

<h2 id="results">Results</h2>
<p class="quiet">IQM is the interquartile mean over seeds; brackets hold 95 % bootstrap intervals.
All objectives train on the same seeds, so differences are paired. The area under the curve is the
mean return over the training. An interval that includes zero leaves a difference undecided.</p>
{% for comparison in comparisons %}
<section>
<h3>{{ comparison.name }}</h3>
{{ figure(comparison.name, "Return on " ~ comparison.name ~ " over the training and at its end, "
  ~ "interquartile mean over seeds with 95 % intervals.") }}
<table class="results stack">
<thead><tr>
{% for label in comparison.columns.values() %}
<th scope="col">{{ label | unbroken }}</th>
{% endfor %}
</tr></thead>
<tbody>
{% for row in comparison.rows %}
<tr{% if row.learned %} class="learned"{% endif %}>
<th scope="row">{{ row.cells.objective }}</th>
{% for key in ("final", "area", "difference") %}
<td data-label="{{ comparison.columns[key] }}"><span class="number">{{ row.cells[key] }}</span>
{%- if key == "difference" and row.verdict %}
 <span class="verdict {{ row.verdict }}">{{ row.verdict }}</span>{% endif %}</td>
{% endfor %}
{% for key in ("n", "episodes", "backend", "actions") %}
<td class="short" data-label="{{ comparison.columns[key] }}">{{ row.cells[key] }}</td>
{% endfor %}
</tr>
{% endfor %}
</tbody>
</table>
<p class="quiet">Trained for {{ comparison.steps }} environment steps; seeds {{ comparison.seeds }}.
{% if comparison.few_seeds %}
With so few seeds, bootstrap intervals are too narrow: read 95 % as about 90 % or less.
{% endif %}
{% if comparison.backend %}
Returns under {{ comparison.backend }} physics cannot be compared with those under another backend.
{% endif %}
</p>
</section>
{% endfor %}

{% if meta %}
<h2 id="meta-training">Meta-training</h2>
<p>The objective was learned on {{ meta.environment }} in {{ meta.generations }} generations,
{{ meta.duration }} and {{ meta.total }} environment steps of its candidates.</p>
{{ figure("meta_training", "Fitness over the generations: the population, and the mean of the "
  ~ "search distribution, which is the result.") }}
<h3>Environment steps</h3>
<table class="steps{% if meta.compared %} stack{% endif %}">
<thead><tr><th scope="col">steps</th><th scope="col">on {{ meta.environment }}</th>
{% if meta.compared %}
<th scope="col">same on {{ meta.home }}</th><th scope="col">{{ meta.environment }} takes</th>
{% endif %}
</tr></thead>
<tbody>
{% for row in meta.rows %}
<tr><th scope="row">{{ row.what }}</th>
<td data-label="on {{ meta.environment }}">{{ row.here }}</td>
{% if meta.compared %}
<td data-label="same on {{ meta.home }}">{{ row.there }}</td>
<td data-label="{{ meta.environment }} takes">{{ row.ratio }}</td>
{% endif %}
</tr>
{% endfor %}
</tbody>
</table>
{{ figure("environment_steps", "Environment steps of this meta-training and of the same on the "
  ~ "environment itself, on a logarithmic axis.") }}
<details>
<summary>Configuration of the meta-training</summary>
{{ pairs(meta.config) }}
</details>
{% endif %}

{% if certificate or "drift_heatmaps" in figures %}
<h2 id="objective">The objective</h2>
{% endif %}
{% if "drift_heatmaps" in figures %}
<p>The top row shows the drift, what an objective charges for moving the probability ratio r of an
action with advantage A away from 1; dark is expensive. The bottom row shows which way the whole
objective pulls the ratio: red up, blue down, white not at all, and hatched where it pulls against
the advantage, so that the update is rolled back.</p>
{{ figure("drift_heatmaps", "Drift and gradient of the objectives over ratio and advantage.") }}
{% endif %}
{% if certificate %}
<h3>Certificate</h3>
<p>{{ name }}
{% if certificate.holds %}<strong class="yes">is a drift</strong>: it meets the conditions of mirror
learning{% else %}<strong class="no">is not a drift</strong>: it fails the conditions of mirror
learning{% endif %}
 on a grid of {{ certificate.grid }}
{%- if certificate.by_construction %}, as every drift of its family does whatever the weights: what to judge it by is
the slope beside ratio 1{% endif %}.</p>
<table class="stack">
<thead><tr><th scope="col">condition</th><th scope="col">measured</th><th scope="col">required</th>
<th scope="col">holds</th></tr></thead>
<tbody>
{% for row in certificate_rows %}
<tr><th scope="row">{{ row.condition }}</th>
<td class="short" data-label="measured">{{ row.measured }}</td>
<td class="short" data-label="required">{{ row.required }}</td>
<td class="short" data-label="holds">
{%- if row.holds is none %}–{% elif row.holds %}<span class="yes">yes</span>
{%- else %}<span class="no">no</span>{% endif %}</td></tr>
{% endfor %}
</tbody>
</table>
{% endif %}

{% if further %}
<h2>Further figures</h2>
{% for name in further %}
{{ figure(name, name) }}
{% endfor %}
{% endif %}

<h2 id="reproduce">How to reproduce</h2>
{% if command %}
<pre><code>{{ command }}</code></pre>
{% endif %}
<p>The same seeds, versions, machine and devices give the same numbers.
{% for comparison in comparisons %}
Seeds on {{ comparison.name }}: {{ comparison.seeds }}.
{% endfor %}
</p>
<div class="columns">
{% for title, rows in tables.items() %}
<section><h3>{{ title | capitalize }}</h3>
{{ pairs(rows) }}
</section>
{% endfor %}
</div>
</main>
</body>
</html>
"""
