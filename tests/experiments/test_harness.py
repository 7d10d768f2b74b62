import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jinja2
import pytest
from matplotlib.figure import Figure

from experiments import __main__ as everything
from experiments import harness, rendering
from experiments.claims import Claim
from experiments.harness import Experiment
from experiments.rendering import text
from experiments.reports import complete, read
from scb.errors import UserError
from scb.statistics import Estimate
from tests.locking import is_locked

PAGE = """{% extends "page.md.j2" %}
{% block verdict %}{{ measured }} measured.{% endblock %}
{% block body %}{{ report.parts | join(" ") }}{% endblock %}"""


@pytest.fixture(autouse=True)
def template(monkeypatch):
    loaders = [jinja2.DictLoader({"counting.md.j2": PAGE}), rendering.ENVIRONMENT.loader]
    monkeypatch.setattr(rendering.ENVIRONMENT, "loader", jinja2.ChoiceLoader(loaders))


def counting(parts=("a", "b"), fail_at=None) -> Experiment:
    """An experiment that writes down how often each of its parts was measured."""

    def measure(plan, report, save):
        plan["rows"].mkdir(exist_ok=True)  # where it may keep what no part of the report has yet
        for name in parts:
            if report.setdefault("parts", {}).get(name) is not None:
                continue
            if name == fail_at:
                raise KeyboardInterrupt
            report["parts"][name] = plan["value"]
            report["measured"] = report.get("measured", 0) + 1
            save()
        save()  # which changes nothing

    return Experiment(
        name="counting",
        title="Counting",
        paper="no figure",
        claim="parts are measured once.",
        presets={"quick": {"value": 1}, "paper": {"value": 2}},
        minutes={"quick": "0", "paper": "0"},
        measure=measure,
        claims=lambda report: [Claim("every part is there", len(report["parts"]) == 2)],
        draw=lambda report: Figure(figsize=(2, 2)),
    )


def test_a_report_is_one_commands_while_it_measures(tmp_path):
    report, seen = tmp_path / "c.json", []

    def measure(plan, found, save):
        seen.append(is_locked(tmp_path / ".c.json.lock"))
        counting().measure(plan, found, save)

    flags = ["--out", str(report), "--docs", str(tmp_path / "docs")]
    assert replace(counting(), measure=measure).main(flags) == 0
    assert seen == [True] and not (tmp_path / ".c.json.lock").exists()


def test_an_interrupted_measurement_goes_on_and_has_no_page_before(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path / "docs")]
    needing = {"keys": ("parts", "measured", "more")}
    assert replace(counting(fail_at="b"), **needing).main(flags) == 130
    told = "counting: interrupted; the same command measures what its report lacks.\n"
    assert capsys.readouterr().err == told
    assert replace(counting(), **needing).main([*flags, "--only-render"]) == 2
    assert "it lacks more" in capsys.readouterr().err
    assert replace(counting(), **needing).main(flags) == 0
    assert json.loads((tmp_path / "c.json").read_text())["measured"] == 2


def test_an_interrupted_experiment_measures_only_what_is_missing(tmp_path):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path / "docs")]
    assert counting(fail_at="b").main(flags) == 130
    assert (tmp_path / "c.rows").exists()
    assert counting().main(flags) == 0
    assert not (tmp_path / "c.rows").exists()
    report = json.loads((tmp_path / "c.json").read_text())
    assert report["parts"] == {"a": 1, "b": 1} and report["measured"] == 2
    written = (tmp_path / "docs" / "counting.md").read_text()
    assert "**The paper** (no figure): parts are measured once." in written
    assert "**The paper's claim *holds* here:** 2 measured." in written
    assert "quick preset has fewer" in written
    assert (tmp_path / "docs" / "figures" / "counting.png").exists()


def test_where_nothing_is_missing_it_is_said(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]
    for there in (False, True):
        assert counting().main(flags) == 0
        assert ("c.json has all that is asked for already" in capsys.readouterr().out) == there


def test_a_report_stays_with_the_machine_that_measured_it(tmp_path):
    out = tmp_path / "c.json"
    flags = ["--out", str(out), "--docs", str(tmp_path)]
    assert counting().main(flags) == 0
    here = json.loads(out.read_text())
    other = {"processor": "another processor", "cores": 96, "accelerator": "a GPU"}
    elsewhere = {**here, "machine": other, "versions": {"jax": "0.0"}}
    out.write_text(json.dumps(elsewhere))
    assert counting().main(flags) == 0
    assert json.loads(out.read_text()) == elsewhere
    assert "96 cores, another processor" in (tmp_path / "counting.md").read_text()
    # What is measured here is this machine's.
    del elsewhere["parts"]["b"]
    out.write_text(json.dumps(elsewhere))
    assert counting().main(flags) == 0
    assert json.loads(out.read_text())["machine"] == here["machine"]


def test_an_experiment_forgets_what_is_of_a_replaced_bandit_before_it_measures(tmp_path):
    out = tmp_path / "c.json"
    flags = ["--out", str(out), "--docs", str(tmp_path)]
    assert counting().main(flags) == 0
    report = json.loads(out.read_text())
    report["parts"]["a"] = {"sha256": "replaced"}
    out.write_text(json.dumps(report))
    assert counting().main(flags) == 0
    report = json.loads(out.read_text())
    assert report["parts"] == {"a": 1, "b": 1} and report["measured"] == 3


def test_another_preset_does_not_continue_a_report(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]
    assert counting().main(flags) == 0
    assert counting().main([*flags, "--preset", "paper"]) == 2
    assert "choose another --out" in capsys.readouterr().err
    assert json.loads((tmp_path / "c.json").read_text())["preset"] == "quick"


def test_the_report_of_another_experiment_is_left_alone(tmp_path, capsys):
    out = tmp_path / "c.json"
    for content in ('{"entries": []}', '{"experiment": "lemma", "complete": true}'):
        out.write_text(content)
        for flags in ([], ["--only-render"]):
            assert counting().main([*flags, "--out", str(out)]) == 2
            assert "is no report of counting: choose another --out" in capsys.readouterr().err
        assert out.read_text() == content


def test_the_page_of_a_report_elsewhere_is_written_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert counting().main(["--out", "mine/c.json"]) == 0
    assert (tmp_path / "mine" / "counting.md").exists() and not (tmp_path / "docs").exists()
    assert counting().main([]) == 0
    assert (tmp_path / "docs" / "counting.md").exists()


@pytest.mark.parametrize("flag", ["--out", "--docs"])
def test_folders_that_cannot_be_made_are_told_before_measuring(tmp_path, capsys, flag):
    (tmp_path / "file").write_text("precious")
    inside = tmp_path / "file" / "inside"
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]
    flags[flags.index(flag) + 1] = str(inside / "c.json" if flag == "--out" else inside)
    assert counting(fail_at="a").main(flags) == 2
    assert f"choose another {flag}, a folder that you may write to" in capsys.readouterr().err


def test_nothing_to_render_is_an_error(tmp_path, capsys):
    flags = ["--only-render", "--data", str(tmp_path / "typo"), "--docs", str(tmp_path)]
    assert everything.main(flags) == 2
    assert "holds no report of an experiment" in capsys.readouterr().err
    assert not (tmp_path / "experiments.md").exists()


@pytest.mark.parametrize("content", [None, "{", "[1, 2]"])
def test_rendering_without_a_report_says_so(tmp_path, capsys, content):
    out = tmp_path / "c.json"
    if content is not None:
        out.write_text(content)
    assert counting().main(["--only-render", "--out", str(out), "--docs", str(tmp_path)]) == 2
    assert "is no report of this command" in capsys.readouterr().err


def test_estimates_have_real_minus_signs():
    assert text(Estimate(-3.25, -4.0, -2.5, 9), 1) == "−3.2 [−4.0, −2.5]"
    assert text(Estimate(3.0, None, None, 1), sign=True) == "+3"


def test_every_experiment_says_what_it_is_and_takes():
    for experiment in everything.of_the_paper():
        assert set(experiment.presets) == set(experiment.minutes) == {"quick", "paper"}
        assert experiment.claim.endswith(".")
    # By name, or as the module of that name.
    folder = Path(everything.__file__).parent
    assert all((folder / f"{name}.py").exists() for name in everything.found())


def test_the_list_names_every_command(capsys):
    assert everything.main(["--list"]) == 0
    printed = capsys.readouterr().out
    for name in everything.found():
        assert f"  {name}: " in printed
    assert "quick 1 min" in printed
    assert "rejax_peer" not in printed


def test_one_experiment_is_run_by_its_name(tmp_path, monkeypatch, capsys):
    module = SimpleNamespace(EXPERIMENT=counting())
    monkeypatch.setitem(sys.modules, "experiments.counting", module)
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]
    assert everything.main(["counting", *flags, "--preset", "paper"]) == 0
    assert json.loads((tmp_path / "c.json").read_text())["preset"] == "paper"
    for name in ("lema", "harness", "lemma.x"):  # none, and a module without one
        assert everything.main([name]) == 2
        assert f"unknown experiment {name!r}: " in capsys.readouterr().err


def test_all_experiments_in_one_go_leave_one_page(tmp_path, monkeypatch):
    monkeypatch.setattr(everything, "found", lambda: {"counting": counting()})
    flags = ["--data", str(tmp_path / "data"), "--docs", str(tmp_path / "docs")]
    assert everything.main(flags) == 0
    overview = (tmp_path / "docs" / "experiments.md").read_text()
    assert "## [Counting](counting.md)" in overview and "2 measured." in overview
    assert "| [Counting](counting.md) | no figure | holds | 1 | 0 | 0 | quick |" in overview
    assert everything.main([*flags, "--preset", "paper"]) == 2
    (tmp_path / "data" / "counting.json").write_text("{")
    assert everything.main(flags) == 2
    assert "Its report cannot be read." in (tmp_path / "docs" / "experiments.md").read_text()


def test_the_overview_says_so_of_a_report_that_lacks_what_its_page_needs(tmp_path):
    experiment = replace(counting(), keys=("measured", "added later"))
    report = {"preset": "quick", "complete": True, "parts": {"a": 1, "b": 1}, "measured": 2}
    (tmp_path / "counting.json").write_text(json.dumps(report))
    assert "Its report cannot be read." in everything.overview([experiment], tmp_path)


def test_the_quick_presets_in_one_go_keep_a_report_of_the_papers_size(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(everything, "found", lambda: {"counting": counting()})
    flags = ["--data", str(tmp_path / "data"), "--docs", str(tmp_path / "docs")]
    assert everything.main([*flags, "--preset", "paper"]) == 0
    measured = (tmp_path / "data" / "counting.json").read_bytes()
    assert everything.main(flags) == 0
    assert "kept: it has the paper's size" in capsys.readouterr().out
    assert (tmp_path / "data" / "counting.json").read_bytes() == measured


def test_a_report_that_is_not_complete_makes_no_page(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "counting.json"), "--docs", str(tmp_path / "docs")]
    assert counting(fail_at="b").main(flags) == 130
    assert counting().main([*flags, "--only-render"]) == 2
    told = "not complete: leave out --only-render, with --preset quick, and the command goes on"
    assert told in capsys.readouterr().err
    (tmp_path / "list.json").write_text("[]")
    assert counting().main(["--out", str(tmp_path / "list.json")]) == 2
    assert "is no report of this command (it is no JSON object)" in capsys.readouterr().err
    (tmp_path / "empty.json").write_text("{}")
    empty = ["--out", str(tmp_path / "empty.json"), "--docs", str(tmp_path), "--only-render"]
    assert counting().main(empty) == 2
    assert "not complete" in capsys.readouterr().err
    assert "Measured in part only" in everything.overview([counting()], tmp_path)
    assert counting().main(flags) == 0
    assert "2 measured." in everything.overview([counting()], tmp_path)


def test_a_report_of_another_plan_is_not_continued(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]
    assert counting().main(flags) == 0
    presets = {"quick": {"value": 3}, "paper": {"value": 2}}
    assert replace(counting(), presets=presets).main(flags) == 2
    assert "when the preset quick was another one" in capsys.readouterr().err


def test_a_report_goes_on_where_only_what_may_grow_has_grown(tmp_path, capsys):
    flags = ["--out", str(tmp_path / "c.json"), "--docs", str(tmp_path)]

    def growing(quick) -> Experiment:
        return replace(counting(), presets={"quick": quick, "paper": {"value": 2}}, grows=("of",))

    first = {"value": 1, "of": [["x"]], "by": {"x": 1}}
    assert growing(first).main(flags) == 0
    longer = {**first, "of": [["w"], ["x"]]}
    assert growing(longer).main(flags) == 0
    report = json.loads((tmp_path / "c.json").read_text())
    assert report["plan"] == longer and report["measured"] == 2
    for other in ({**longer, "by": {"x": 1, "y": 2}}, {**longer, "of": [["x"]]}):
        assert growing(other).main(flags) == 2
        assert "when the preset quick was another one" in capsys.readouterr().err
    tables = {"value": 1, "of": {"x": 1}}
    (tmp_path / "c.json").unlink()
    assert growing(tables).main(flags) == 0
    assert growing({"value": 1, "of": {"x": 1, "y": 2}}).main(flags) == 0
    assert growing({"value": 1, "of": {"x": 2, "y": 2}}).main(flags) == 2


def test_a_folder_in_the_place_of_a_program_is_told(tmp_path):
    with pytest.raises(UserError, match=r"cannot be run \(.*\): give a program of Python"):
        harness.last_line([str(tmp_path)])
    assert harness.last_line([sys.executable, "-c", "print('{\"a\": 1}')"]) == {"a": 1}


def test_equal_numbers_are_a_number_and_others_a_span():
    assert rendering.span([3, 3]) == "3" and rendering.span([30, 60, 30]) == "30 to 60"


def test_an_end_that_is_not_zero_within_two_more_places_is_not_written_as_zero():
    assert text({"value": 0.134, "low": 0.004, "high": 0.26}, 2, sign=True) == "+0.13 [0.004, 0.26]"
    assert (
        text({"value": 0.004, "low": -0.004, "high": 0.02}, 2) == "0.00 [\N{MINUS SIGN}0.004, 0.02]"
    )
    assert text({"value": 0.002, "low": 0.001, "high": 0.004}, 2) == "0.002 [0.001, 0.004]"
    assert text({"value": 0.03, "low": 0.0004, "high": 0.06}, 2) == "0.03 [0.0004, 0.06]"
    assert text({"value": 0.0, "low": 0.0, "high": 0.00002}, 2) == "0.00 [0.00, 0.00]"
    # Of whole points a tenth says nothing.
    assert text({"value": 4.0, "low": 0.2, "high": 9.0}) == "4 [0, 9]"


# Tools make no page, and some studies are only quoted elsewhere.
PAGES = [x for x in everything.found().values() if rendering.has_template(x.name)]


@pytest.fixture(scope="module")
def once():
    """What is computed of a committed report is so once, for its pages and for the overview."""
    computed, known = Experiment.context, {}

    def context(experiment, report):
        if experiment.name not in known:
            known[experiment.name] = computed(experiment, report)
        return known[experiment.name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Experiment, "context", context)
        yield


@pytest.mark.parametrize("experiment", PAGES, ids=[x.name for x in PAGES])
@pytest.mark.usefixtures("once")
def test_the_committed_page_is_that_of_the_committed_report(experiment):
    out = experiment.out or harness.DATA / f"{experiment.name}.json"
    report = read(out, keys=experiment.keys)
    if experiment.presets:
        plan = json.loads(json.dumps(experiment.presets[report["preset"]]))
        assert complete(report) and report.get("plan", plan) == plan
    pages = experiment.pages(report)
    assert pages.keys() == {experiment.name, *experiment.further}
    assert {name: (harness.DOCS / f"{name}.md").read_text() for name in pages} == pages


@pytest.mark.usefixtures("once")
def test_the_committed_overview_is_that_of_the_committed_reports():
    experiments = everything.of_the_paper()
    assert (harness.DOCS / "experiments.md").read_text() == everything.overview(
        experiments, harness.DATA
    )
