"""How pages are made of templates: Jinja's environment and the filters that write numbers."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from experiments.claims import FAILS, HOLDS, OUTCOMES, UNDECIDED, UNTESTED, Judged
from scb.plotting import thousands
from scb.statistics import Estimate, estimate, places_apart, typeset

TEMPLATES = Path(__file__).with_name("templates")


def number(value: float, places: int = 0, sign: bool = False) -> str:
    """With a real minus sign."""
    return typeset(f"{value:{'+' if sign else ''}z.{places}f}")


def plain(value: float | None) -> str:
    """To one place, where that is none that is zero; "none" where there is no number."""
    return "none" if value is None else number(value, 1).removesuffix(".0")


def millions(steps: float) -> str:
    """A number of steps as a table shows it: 12.5 million, 40 960."""
    return f"{plain(steps / 1e6)} million" if steps >= 1e6 else thousands(steps)


def text(value: Estimate | Mapping[str, Any] | Any, places: int = 0, sign: bool = False) -> str:
    """An estimate with its interval; [N] runs are estimated."""
    if not isinstance(value, Mapping | Estimate):
        value = estimate(value)
    values: Any = value if isinstance(value, Mapping) else value.as_dict()
    found, low, high = (values[x] for x in ("value", "low", "high"))
    if low is None:
        return number(found, places, sign)
    decides = low * high > 0

    def shown(x: float, most: int) -> int:
        # Of whole points a tenth says nothing.
        return places_apart(places, x, most=most) if places else 0

    ends = [number(end, shown(end, 6 if decides else places + 2)) for end in (low, high)]
    middle = number(found, shown(found, places + 2) if decides else places, sign)
    return f"{middle} [{', '.join(ends)}]"


def digits(interval: Mapping[str, Any] | None, sign: bool = False) -> str:
    """An estimate with four digits of its largest number: −194.2 [−262.8, −167.9]."""
    if interval is None:
        return "none"
    found = typeset(str(Estimate(**interval)).rsplit(" (n=", 1)[0])
    return f"+{found}" if sign and interval["value"] > 0 else found


def percent(share: float, places: int = 0) -> str:
    """Such as 12%."""
    return f"{share:.{places}%}"


def listed(parts: Iterable[str]) -> str:
    """Such as "a, b and c"."""
    *first, last = [*parts] or [""]
    return f"{', '.join(first)} and {last}" if first else last


def span(numbers: Iterable[int]) -> str:
    """Such as "30 to 60", or "30" where all are alike."""
    low, high = min(found := list(numbers)), max(found)
    return str(low) if low == high else f"{low} to {high}"


def either(numbers: Iterable[int]) -> str:
    """Such as "30 or 60", each once, or "30" where all are alike."""
    return " or ".join(str(number) for number in sorted(set(numbers)))


def mean_known(values: NDArray[np.floating], places: int) -> str:
    """The mean of those that are numbers, and nothing where none is."""
    known = np.asarray(values)[np.isfinite(values)]
    return number(float(known.mean()), places) if known.size else ""


def said(outcome: str) -> str:
    """With its verb, as in "it holds", "it is not tested at this size"."""
    return f"{'is ' if outcome in (UNDECIDED, UNTESTED) else ''}*{outcome}*"


def told(judged: Sequence[Judged]) -> str:
    """What becomes of the parts of a claim, as in "of its 6 parts 1 is undecided; 5 hold: A; B; ..."."""
    words = {HOLDS: ("holds", "hold"), FAILS: ("does not hold", "do not hold")}
    found = []
    for outcome in OUTCOMES[::-1]:
        if texts := that(judged, outcome):
            word = words.get(outcome, (f"is {outcome}", f"are {outcome}"))[len(texts) > 1]
            which = f": {'; '.join(texts)}" if outcome in words else ""
            found.append(f"{len(texts)} {word}{which}")
    return f"of its {len(judged)} parts {'; '.join(found)}."


def computer(machine: Mapping[str, Any]) -> str:
    """Such as "2 cores, AMD EPYC", of what a report says of the machine that measured."""
    return f"{machine['cores']} core{'s' * (machine['cores'] != 1)}, {machine['processor']}"


def versions(packages: Mapping[str, str]) -> str:
    """Such as "jax 0.11.2, numpy 2.4.0."."""
    return f"{', '.join(f'{name} {version}' for name, version in packages.items())}."


def heads(*columns: str | Iterable[Any]) -> str:
    """The heads of a table, and the rule under them; what an iterable has are so many columns."""
    names = [name for x in columns for name in ([x] if isinstance(x, str) else x)]
    return f"| {' | '.join(map(str, names))} |\n|{' --- |' * len(names)}"


def that(judged: Sequence[Judged], outcome: str) -> list[str]:
    """The parts of a claim with this outcome."""
    return [x.claim.text for x in judged if x.outcome == outcome]


def on(machines: Iterable[Mapping[str, Any]]) -> str:
    """Kinds of machines, each once by its accelerator or its number of cores: "2 cores, H100"."""
    names = (
        f"{x['cores']} core{'s' * (x['cores'] != 1)}"
        if x["accelerator"] == "none"
        else x["accelerator"].removeprefix("NVIDIA ").split()[0]
        for x in machines
    )
    return ", ".join(dict.fromkeys(names))


def algorithms(names: Sequence[str], otherwise: str = "all of the paper's algorithms") -> str:
    """Such as "PPO, SAC"; a plan's empty list stands for all."""
    return ", ".join(name.upper() for name in names) or otherwise


ENVIRONMENT = jinja2.Environment(
    loader=jinja2.FileSystemLoader(TEMPLATES),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
ENVIRONMENT.filters |= {
    "algorithms": algorithms,
    "computer": computer,
    "digits": digits,
    "listed": listed,
    "mean_known": mean_known,
    "millions": millions,
    "number": number,
    "on": on,
    "percent": percent,
    "plain": plain,
    "positional": lambda x: np.format_float_positional(x, trim="-"),
    "said": said,
    "short": lambda x: typeset(f"{x:g}"),
    "spaced": lambda x: f"{x:,}".replace(",", " "),
    "span": span,
    "text": text,
    "that": that,
    "told": told,
    "versions": versions,
}
ENVIRONMENT.globals["heads"] = heads


def has_template(name: str) -> bool:
    """Whether an experiment makes a page."""
    return f"{name}.md.j2" in ENVIRONMENT.list_templates()


def template(name: str) -> jinja2.Template:
    """templates/NAME.md.j2."""
    return ENVIRONMENT.get_template(f"{name}.md.j2")


def block(name: str, part: str, context: Mapping[str, Any]) -> str:
    """One block of a page's template."""
    found = template(name)
    return "".join(found.blocks[part](found.new_context(dict(context)))).strip()
