"""What the documentation says is what was measured, and its links lead somewhere."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from experiments import rendering
from experiments.reports import bandit_of, forget_replaced
from lpo.full_size import full_size
from lpo.suite import SuiteScores
from scb.environments.zoo import bandit_metadata, zoo_names
from scb.statistics import estimate
from tests.site import public_names

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", *DOCS.glob("*.md")])


def prose(page):
    """A page without its blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.S)


def anchors(page):
    """What headings of a page are linked by."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", page.read_text(), re.M):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower().replace("`", "")
        found.add(re.sub(r"[^\w\- ]", "", plain).strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_no_page_has_a_section_twice(page):
    sections = re.findall(r"^## (.*)$", prose(page), re.M)
    assert len(sections) == len(set(sections))


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_a_table_stands_apart_from_what_is_before_it(page):
    # Else Markdown shows its lines as text of the paragraph.
    assert re.findall(r"^[^|\n].*\n(\|.*)", prose(page), re.M) == []


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_every_link_leads_somewhere(page):
    text = prose(page)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        # The last two are made by `make docs`, which checks links to them.
        if target.startswith(("http://", "https://", "interactive/", "notebooks/")):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def test_every_page_of_the_documentation_is_in_its_navigation():
    def files(nav):
        if isinstance(nav, str):
            return [nav]
        return [file for x in (nav.values() if isinstance(nav, dict) else nav) for file in files(x)]

    listed = files(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    notebooks = [f"notebooks/{file.stem}.md" for file in (ROOT / "notebooks").glob("*.ipynb")]
    assert sorted(listed) == sorted([*(page.name for page in DOCS.glob("*.md")), *notebooks])


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])


def test_the_reference_has_every_public_name():
    for page, name in public_names():
        assert f"\n::: {name}\n" in (DOCS / f"{page}.md").read_text(), name


def read(name):
    return json.loads((DOCS / "data" / f"{name}.json").read_text())


@pytest.mark.parametrize("data", sorted(p.stem for p in (DOCS / "data").glob("*.json")))
def test_what_was_measured_of_bandits_is_of_those_that_ship(data):
    report = read(data)
    forget_replaced(report)
    assert report == read(data)


def test_every_report_that_names_its_bandits_by_checksum_can_forget_them(monkeypatch):
    # Else the test above would see nothing. The table's entries are a list, which measures again by itself.
    monkeypatch.setattr("experiments.reports.zoo_names", lambda: [])
    naming, forgetting = set(), set()
    for path in (DOCS / "data").glob("*.json"):
        report = read(path.stem)
        forget_replaced(report)
        if '"sha256"' in path.read_text():
            naming.add(path.stem)
        if report != read(path.stem):
            forgetting.add(path.stem)
    assert len(naming) > 5 and naming == forgetting | {"zoo_table"}


def test_what_agents_of_another_library_trained_in_ships():
    digests = read("sb3")["bandits"]
    assert digests and digests == {name: bandit_of(name)[1] for name in digests}


def test_what_the_table_has_of_our_bandits_is_of_those_that_ship():
    shipped = {bandit_metadata(name)["sha256"] for name in zoo_names()}
    entries = read("zoo_table")["entries"]
    assert {entry["sha256"] for entry in entries if entry["bandit"] == "ours"} == shipped


@pytest.mark.parametrize(
    ("data", "page"),
    [("pendulum", "pendulum"), ("pendulum_small_last_layer", "pendulum")],
)
def test_a_table_of_objectives_says_what_was_measured(data, page):
    report, text = read(data), (DOCS / f"{page}.md").read_text()
    for curve in report["curves"]:
        cells = [rendering.text(curve[x]) for x in ("final_iqm", "area_iqm")]
        if curve["objective"] != report["reference"]:
            difference = report["paired_differences"][curve["objective"]]
            cells.append(rendering.text(difference, sign=True))
        assert f"| {' | '.join(cells)} |" in text, curve["objective"]


IN_SUITES = {
    "ppo": "PPO, clip 0.2",
    "dpo": "DPO",
    "ppo-0.5": "PPO, clip 0.5, tuned on all five",
    "dpo-2-0.3": "DPO, α = 2, β = 0.3, tuned on all five",
}


def suite_scores(name, *without):
    report = read(f"suite_{name}")
    columns = [[e[x] for e in report["environments"]] for x in ("random", "reference", "source")]
    names, scores = [e["name"] for e in report["environments"]], np.array(report["scores"])
    found = SuiteScores(names, report["objectives"], scores, *columns, report["left_out"])
    return found.without(*without)


def minus(scores, one, other):
    # All stay, for the best of them may be what scores are normalised by.
    order = sorted(scores.objectives, key=lambda name: name != other)
    places = [scores.objectives.index(x) for x in order]
    found = replace(scores, objectives=order, scores=scores.scores[places]).differences()
    return rendering.text(found[order.index(one)], 2, sign=True)


@pytest.mark.parametrize("suite", ["classic", "minatar"])
def test_a_table_of_a_suite_says_what_was_measured(suite):
    report, text = read(f"suite_{suite}"), (DOCS / "suites.md").read_text()
    for scores in filter(None, (report, report["elsewhere"])):
        rows = zip(scores["objectives"], scores["aggregate"], scores["differences"], strict=True)
        for i, (objective, aggregate, difference) in enumerate(rows):
            cells = [IN_SUITES.get(objective, f"`{objective}`"), rendering.text(aggregate, 2)]
            cells.append(rendering.text(difference, 2, sign=True) if i else "")
            assert f"| {' | '.join(cells)} |" in text


def test_what_is_said_of_suites_beside_the_tables_follows_from_the_data():
    text = (DOCS / "suites.md").read_text()
    five = suite_scores("classic", "none")
    three = five.without("CartPole-v1", "Pendulum-v1")
    for row, one, other in (
        ("`lpo-pendulum` − clip 0.5", "lpo-pendulum", "ppo-0.5"),
        ("`lpo-pendulum` − DPO", "lpo-pendulum", "dpo"),
        ("`lpo-pendulum` − DPO, tuned", "lpo-pendulum", "dpo-2-0.3"),
        ("DPO, tuned − DPO", "dpo-2-0.3", "dpo"),
    ):
        assert f"| {row} | {minus(three, one, other)} | {minus(five, one, other)} |" in text
    for car in ("MountainCar-v0", "MountainCarContinuous-v0"):
        assert "[−" in minus(three.without(car), "lpo-pendulum", "ppo")
    games = suite_scores("minatar", "Breakout-MinAtar")
    assert f"no lead is shown: {minus(games, 'lpo-multi', 'ppo')}." in text
    for name, objective, without in (
        ("classic_first", "lpo-pendulum", ("CartPole-v1", "Pendulum-v1")),
        ("minatar_first", "lpo-multi", ("none",)),
    ):
        suggested = minus(suite_scores(name, *without), objective, "ppo")
        assert f"suggested it, {suggested}" in text.replace("\n", " ")


def test_what_counts_as_tuned_on_classic_control_was_best_where_it_was_chosen():
    scores = suite_scores("classic_choice", "none")
    earned = {x: y.value for x, y in zip(scores.objectives, scores.aggregate(), strict=True)}
    for family, chosen in (("ppo", "ppo-0.5"), ("dpo", "dpo-2-0.3")):
        of_it = [x for x in earned if x.startswith(family)]
        assert max(of_it, key=earned.__getitem__) == chosen


def test_what_readme_says_of_objectives_stands_in_the_results():
    readme = (ROOT / "README.md").read_text()
    pages = "".join((DOCS / f"{name}.md").read_text() for name in ("pendulum", "suites"))
    rows = [
        line
        for line in readme.splitlines()
        if line.startswith(("| Pendulum,", "| [classic", "| [MinAtar"))
    ]
    numbers = re.findall(r"[−\d.]+ \[[^]]*\]", "".join(rows))
    assert len(numbers) == 12
    for number in numbers:
        assert number in pages, number


def test_what_readme_says_of_hopper_is_of_the_seeds_that_all_three_have():
    of_it = {curve.objective: curve for curve in full_size("hopper").curves}
    curves = [of_it[name] for name in ("ppo", "dpo", "lpo-pendulum")]
    shared = sorted(set.intersection(*(set(curve.seeds) for curve in curves)))
    ends = [[c.final[c.seeds.index(seed)] for seed in shared] for c in curves]
    readme = (ROOT / "README.md").read_text()
    row = " | ".join(rendering.text(estimate(end)) for end in ends)
    assert f"| [Brax Hopper](docs/locomotion.md), at the end | {row} |" in readme
    assert f"Hopper: the {len(shared)} seeds that all three have" in readme


def intervals(text):
    """The ends of what stands in brackets, without their signs: a lead of one is a lag of the other."""
    found = re.findall(r"\[([−\d.]+), ([−\d.]+)\]", text)
    return {frozenset(end.strip("−") for end in pair) for pair in found}


def test_what_is_said_of_hopper_elsewhere_stands_on_its_page():
    def read_between(path, start, end):
        return path.read_text().partition(start)[2].partition(end)[0]

    # What is added is of the seeds of one claim alone.
    known = intervals((DOCS / "locomotion.md").read_text() + "[−48, 127]")
    for path, start, end in (
        (ROOT / "README.md", "| on [Hopper]", "\n"),
        (DOCS / "results.md", "| To locomotion?", "\n"),
        (DOCS / "aims.md", "*Hopper.*", "A bandit that ranks"),
    ):
        said = intervals(read_between(path, start, end))
        assert said and said <= known, path


def test_what_is_folded_is_closed_and_rendered():
    folded = [page.read_text() for page in PAGES if "<details" in page.read_text()]
    assert folded
    for text in folded:
        assert text.count("<details markdown><summary>") == text.count("\n\n</details>\n")
    assert "- md_in_html" in (ROOT / "mkdocs.yml").read_text()
