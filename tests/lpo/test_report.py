"""The report must say what the numbers allow to say, all of it, and load nothing from elsewhere."""

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from lpo import report
from lpo.comparison import Comparison, LearningCurves
from scb import plotting

VOID = {"meta", "link", "img", "br", "hr"}


class Page(HTMLParser):
    """Elements, text and references of a page; fails on tags that do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self._open
        self.text = " ".join(self.text.split())  # no-break spaces become spaces, too

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [v for k, v in attrs if k in ("src", "href", "srcset", "action")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag
        if tag in ("td", "th"):
            self.text += " "

    def handle_data(self, data):
        if self._open and self._open[-1] != "style":
            self.text += data


def curves(objective: str, final: float, seeds: int = 12, **changes: Any) -> LearningCurves:
    noise = np.random.default_rng(len(objective)).normal(size=(seeds, 3))
    arguments: dict[str, Any] = {
        "environment": "Pendulum-v1",
        "backend": None,
        "objective": objective,
        "steps": np.array([0, 5_000, 10_000]),
        "returns": np.array([-1000.0, -500.0, final]) + noise,
        "seeds": list(range(seeds)),
        "episodes": 20,
        "mode_actions": True,
    }
    return LearningCurves(**(arguments | changes))


def comparison(gain: float = 30.0, learned: str = "mine", **changes: Any) -> Comparison:
    names = {"ppo": -180.0, "dpo": -190.0, learned: -180.0 + gain}
    return Comparison([curves(name, final, **changes) for name, final in names.items()])


def difference(low: float | None, high: float | None, value: float = 1.0, n: int = 20) -> Any:
    """A comparison of which only the difference matters."""
    estimate = {"value": value, "low": low, "high": high, "n": n}
    return {"curves": [], "reference": "ppo", "paired_differences": {"mine": estimate}}


def results(**changes: Any) -> dict[str, Any]:
    certificate = {
        "holds": True,
        "minimum": 0.0,
        "value_at_one": 0.0,
        "gradient_at_one": 0.0,
        "slope_at_0_001": 0.123,
        "slope_at_0_01": 0.456,
        "kink": 0.0789,
        "finite": True,
        "grid": "11 log-ratios",
    }
    made: dict[str, Any] = {
        "preset": "quick",
        "command": "lpo run --preset quick",
        "versions": {"jax": "0.10.2"},
        "machine": {"processor": "2 cores"},
        "objective": {"name": "mine", "certificate": certificate},
        "meta_training": {
            "environment": "Synthetic-Pendulum-v1",
            "evaluation_environment": "Pendulum-v1",
            "config": {
                "fitness": "transfer",
                "evolution": {"seed": 7, "population_size": 32},
                "learning_rates": [0.001, 0.01],
                "evaluations": [{"environment": "hopper", "backend": None}],
            },
            "seconds": 123.4,
            "generations": 40,
            "steps": {"training": 1_000_000, "evaluation": 500, "total": 1_000_500},
            "environment_steps": {
                "training": 120_000_000,
                "evaluation": 500,
                "total": 120_000_500,
            },
        },
        "comparisons": {
            "Pendulum-v1": comparison().as_dict(),
            "hopper": comparison(
                -100.0, seeds=12, environment="hopper", backend="spring", mode_actions=False
            ).as_dict(),
        },
        "seconds": 4000.0,
    }
    return made | changes


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    return plotting.save(Figure(figsize=(1, 1)), tmp_path / "picture.png")


def write(folder: Path, made: dict[str, Any] | None = None, **shown: Path) -> Page:
    return Page(report.write_report(folder, made or results(), shown))


@pytest.mark.parametrize("gain", [30.0, -250.0])
def test_the_page_holds_every_number_of_the_table(tmp_path, gain):
    made = comparison(gain)
    page = write(tmp_path, results(comparisons={"Pendulum-v1": made.as_dict()}))
    data = made.as_dict()
    rows = [row["cells"] for row in report._rows(data, learned=None)]
    cells = [cell for row in rows for cell in row.values()]
    assert len(cells) == 3 * 8
    assert "difference to ppo [95 %]" in page.text
    assert "compared with others under PPO; preset quick; 1 h" in page.text
    for cell in cells:
        assert cell in page.text


def test_the_page_shows_cost_certificate_configuration_and_how_to_repeat_it(tmp_path):
    text = write(tmp_path).text
    for said in (
        "1 000 500", "120 000 500", "120 times fewer", "the same",  # steps, and their ratio
        "2 min 3 s", "1 h 6 min", "40 generations",
        "evolution.population_size 32", "evolution.seed 7", "learning_rates 0.001, 0.01",
        "evaluations.1.environment hopper", "evaluations.1.backend –",
        "is a drift", "0.123", "0.456", "11 log-ratios",
        "lpo run --preset quick", "jax 0.10.2", "processor 2 cores", "hopper: 0 to 11",
    ):  # fmt: skip
        assert said in text, said


def test_names_are_escaped(tmp_path):
    evil = "<script>alert('x')</script>"
    made = results(
        objective=results()["objective"] | {"name": evil},
        comparisons={f"<b>{evil}": comparison(learned=evil).as_dict()},
        command=f"lpo run --objective {evil}",
        machine={evil: "<img src=x>"},
    )
    page = write(tmp_path, made)
    assert "script" not in page.tags and "img" not in page.tags and "b" not in page.tags
    assert evil in page.text
    assert evil not in page.source


def test_the_page_loads_nothing_from_elsewhere(tmp_path, picture):
    page = write(tmp_path, meta_training=picture, hopper=picture)
    assert "img" in page.tags
    assert all(reference.startswith("data:") for reference in page.references)
    assert not re.search(r"https?:|url\(|@import|<script", page.source)
    assert "default-src 'none'" in page.source


def test_images_are_embedded_whole_and_once(tmp_path, picture):
    page = write(tmp_path, drift_and_gradient=picture)
    images = [r for r in page.references if r.startswith("data:image/png;base64,")]
    assert [base64.b64decode(i.partition(",")[2]) for i in images] == [picture.read_bytes()]
    assert 'width="200" height="200"' in page.source  # 1 inch at 200 dpi


def test_learning_curves_stand_with_their_environment(tmp_path, picture):
    page = write(tmp_path, hopper=picture)
    own = page.source.index('alt="Return on hopper')
    assert page.source.index("<h3>hopper</h3>") < own < page.source.index("Meta-training</h2>")


def test_trainings_of_full_size_stand_under_a_short_one(tmp_path, picture):
    whole = comparison(seeds=2, environment="hopper", backend="generalized").as_dict()
    page = write(tmp_path, results(full_size={"hopper": whole}), hopper_full_size=picture)
    assert "below, of 10 000 steps under generalized physics" in page.text
    assert "(agents: ppo 2, dpo 2, mine 2; too few to rank them)" in page.text
    # Behind hopper's own table, not Pendulum's.
    own = page.source.index('alt="Return on hopper over trainings of')
    assert page.source.index("<h3>hopper</h3>") < own < page.source.index("Meta-training</h2>")
    assert "What this can tell" not in write(tmp_path).text


@pytest.mark.parametrize(
    ("low", "high", "verdict", "said"),
    [
        (0.5, 2.0, "better", "mine ends better than PPO's clip on Pendulum-v1"),
        (-3.0, -0.5, "worse", "mine ends worse than PPO's clip on Pendulum-v1"),
        (-0.5, 2.0, "undecided", "No difference between mine and PPO's clip could be shown"),
        (0.0, 2.0, "undecided", "includes zero"),
        (-2.0, 0.0, "undecided", "includes zero"),
        (None, None, "few seeds", "One seed cannot tell mine from PPO's clip"),
    ],
)
def test_the_headline_claims_only_what_the_interval_allows(tmp_path, low, high, verdict, said):
    found = difference(low, high, n=20 if low is not None else 1)
    made = results(comparisons={"Pendulum-v1": found})
    headline = report.headlines(made)[0]
    assert headline.verdict == verdict
    assert said in str(headline)
    assert ("better" in str(headline)) == (verdict == "better")


def test_the_headline_gives_the_difference_with_its_sign_and_interval():
    made = results(comparisons={"Pendulum-v1": difference(-31.2, -8.9, value=-20.4)})
    assert "−20 [−31, −9] (mine minus ppo" in str(report.headlines(made)[0])
    assert "20 paired seeds, 95 % interval" in str(report.headlines(made)[0])


def test_the_headline_is_about_the_environment_that_the_bandit_stands_for():
    made = results(comparisons={"hopper": difference(1, 2), "Pendulum-v1": difference(-2, -1)})
    assert report.headlines(made)[0].verdict == "worse"
    # Learned elsewhere altogether: the first comparison.
    made["meta_training"] = {}
    assert report.headlines(made)[0].verdict == "better"


def test_a_worse_result_elsewhere_stands_beside_a_good_headline(tmp_path):
    page = write(tmp_path)
    assert report.headlines(results())[0].verdict == "better"
    before_the_results = page.text.partition("Results")[0]
    assert "mine ends worse than PPO's clip on hopper" in before_the_results


def test_an_objective_that_was_not_compared_is_not_praised(tmp_path):
    alone = Comparison([curves("mine", -100.0)]).as_dict()
    page = write(tmp_path, results(comparisons={"Pendulum-v1": alone}))
    assert "mine was compared with no other objective." in page.text
    assert "better" not in page.text


def test_an_end_of_an_interval_is_never_rounded_to_zero():
    # Two digits of the half-width 20 are no decimals, which would print the lower end as 0.
    made = results(comparisons={"Pendulum-v1": difference(0.04, 40.0, value=20.0)})
    assert "+20.00 [+0.04, +40.00]" in str(report.headlines(made)[0])


@pytest.mark.parametrize(("seeds", "warned"), [(1, True), (5, True), (20, False)])
def test_few_seeds_come_with_a_warning(tmp_path, seeds, warned):
    made = results(comparisons={"Pendulum-v1": comparison(seeds=seeds).as_dict()})
    assert ("With fewer than 10 agents no interval decides" in write(tmp_path, made).text) == warned
    verdict = report.headlines(made)[0].verdict
    assert (verdict == "few seeds") == warned


def test_physics_and_actions_are_named(tmp_path):
    made = results()
    page = write(tmp_path, made)
    assert "Returns under spring physics cannot be compared" in page.text
    sampled = comparison(backend="spring", mode_actions=False).as_dict()
    for row in report._rows(sampled, learned=None):
        assert list(row["cells"].values())[-3:] == ["20", "spring", "sampled"]


def test_a_page_says_how_many_agents_are_above_standing_still(tmp_path):
    speeds = np.full((12, 3), 0.5)
    moving = comparison(1230.0, environment="hopper", backend="spring", speeds=speeds)
    said = write(tmp_path, results(comparisons={"hopper": moving.as_dict()})).text
    assert "standing still (1000), with the mean speed of all: ppo 0 of 12, 0.50 m/s;" in said
    assert "mine 12 of 12, 0.50 m/s." in said and "No agent is above" not in said
    still = comparison(30.0, environment="hopper", backend="spring", speeds=speeds)
    said = write(tmp_path, results(comparisons={"hopper": still.as_dict()})).text
    assert "No agent is above standing still (1000): of moving, this tells" in said


def test_a_failed_certificate_is_not_hidden(tmp_path):
    made = results()
    made["objective"]["certificate"] |= {"holds": False, "minimum": -0.25}
    text = write(tmp_path, made).text
    assert "mine is not a drift" in text
    assert "smallest penalty f -0.25 ≥ 0 no" in text


def test_what_rounding_leaves_of_nothing_is_no_failed_condition(tmp_path):
    made = results()
    made["objective"]["certificate"] |= {"holds": True, "minimum": -1e-7, "gradient_at_one": 2e-6}
    text = write(tmp_path, made).text
    assert "mine is a drift" in text
    assert "smallest penalty f -1e-07 ≥ 0, but for rounding yes" in text
    assert "largest |df/dr| at ratio 1 2e-06 0, but for rounding yes" in text


def test_results_read_from_a_file_give_the_same_bytes(tmp_path, picture):
    made = results()
    first = report.write_report(tmp_path, made, {"hopper": picture}).read_bytes()
    again = json.loads(json.dumps(made))
    assert report.write_report(tmp_path, again, {"hopper": picture}).read_bytes() == first
