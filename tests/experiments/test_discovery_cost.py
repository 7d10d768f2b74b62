"""What the page on costs says must be what the run folders hold."""

import json
import shutil
from dataclasses import replace

import pytest

from experiments import discovery_cost
from scb.configurations import config_dict
from scb.discovery import DiscoveryConfig
from scb.errors import UserError
from scb.evolution import EvolutionConfig

# Seconds and returns by generation: judged before the generations 0 and 2, and after 3.
SECONDS = [60.0, 30.0, 30.0, 120.0]
JUDGED = {0: -400.0, 2: -165.0}
FINAL = -150.0


def run_folder(
    folder, init="expert", environment="Pendulum-v1", judged=None, final=FINAL, rows=4, **config
):
    """A run folder of 100 training and 10 evaluation steps a generation."""
    folder.mkdir()
    evolution = {"seed": config.pop("seed", 3), "num_generations": 4}
    evolution["population_size"] = config.pop("population_size", 32)
    settings = replace(
        DiscoveryConfig(environment=environment, init=init, **config),
        evolution=EvolutionConfig(**evolution),
    )
    stored = {"command": "scb discover", "config": config_dict(settings)}
    (folder / "config.json").write_text(json.dumps(stored))
    lines = []
    for generation in range(rows):
        done = generation + 1
        row = {"generation": generation, "fitness/mean": -9.0}
        row |= {"steps/training": 100 * done, "steps/evaluation": 10 * done}
        row["steps/total"] = 110 * done
        value = (JUDGED if judged is None else judged).get(generation)
        if value is not None:
            row |= {"mean/fitness": value, "mean/fitness/ppo": value}
        if generation == 3 and final is not None:
            row |= {"final_mean/fitness": final, "final_mean/fitness/ppo": final - 1}
            row |= {"final_mean/fitness/sac": final + 1}
        lines.append(json.dumps(row))
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    times = [json.dumps({"generation": i, "seconds": s}) for i, s in enumerate(SECONDS[:rows])]
    (folder / "timing.jsonl").write_text("\n".join(times) + "\n")
    return folder


def bandit_file(folder, refinement=None, **warm_start):
    machine = {"cores": 2, "processor": "AMD EPYC", "accelerator": "none"}
    cost = {"warm_start": warm_start, "refinement": refinement, "machine": machine}
    (folder / "Synthetic-Pendulum-v1.json").write_text(json.dumps({"cost": cost}))


def cells_of(text, start):
    [line] = [line for line in text.splitlines() if line.startswith("| Pendulum-v1 | " + start)]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_point_costs_what_went_before_it(tmp_path):
    [run] = discovery_cost.collect([run_folder(tmp_path / "a", "random")])["runs"]
    # The mean at generation 2 is judged after 60 + 30 s and 2 * 110 steps; the last after all.
    assert run["points"] == [[0, 0.0, 0, -400.0], [2, 1.5, 220, -165.0], [4, 4.0, 440, -150.0]]
    assert (run["minutes"], run["generations"]) == (4.0, 4)
    assert run["steps"] == {"warm_start": 0, "training": 400, "evaluation": 40, "total": 440}


def test_the_target_is_reached_at_the_first_judgement_above_it(tmp_path):
    [run] = discovery_cost.collect([run_folder(tmp_path / "a")])["runs"]
    # Pendulum's target is -170; -165 at generation 2 is the first above it.
    assert run["reached"] == {"generation": 2, "minutes": 1.5, "steps": 220, "mean": -165.0}
    cells = cells_of(discovery_cost.EXPERIMENT.page({"runs": [run], "left_out": []}), "warm")
    assert cells[9:13] == ["−170", "2", "1.5", "220"]
    assert cells[13] == "−150 (PPO −151, SAC −149)"


def test_the_end_shows_interquartile_means_where_they_are_logged(tmp_path):
    [run] = discovery_cost.collect([run_folder(tmp_path / "a")])["runs"]
    run["algorithms"] = {"ppo": -150.0, "ppo_iqm": -140.0}
    cells = cells_of(discovery_cost.EXPERIMENT.page({"runs": [run], "left_out": []}), "warm")
    assert cells[13] == "−150 (IQM: PPO −140)"


def test_a_target_that_is_exactly_met_is_reached(tmp_path):
    [run] = discovery_cost.collect([run_folder(tmp_path / "a", judged={0: -170.0})])["runs"]
    assert run["reached"]["generation"] == 0


def test_a_run_that_never_gets_there_says_so(tmp_path):
    folder = run_folder(tmp_path / "a", judged={0: -400.0}, final=-300.0)
    report = discovery_cost.collect([folder])
    assert report["runs"][0]["reached"] is None
    assert "not reached" in cells_of(discovery_cost.EXPERIMENT.page(report), "warm")


def test_a_warm_start_is_paid_for_where_it_is_recorded(tmp_path):
    known, unknown = run_folder(tmp_path / "a"), run_folder(tmp_path / "b", seed=4)
    bandit_file(known, environment_steps=1000, seconds=30.0)
    report = discovery_cost.collect([known, unknown])
    first, second = report["runs"]
    assert first["points"][0] == [0, 0.5, 1000, -400.0]
    assert first["points"][-1] == [4, 4.5, 1440, -150.0]
    assert (first["minutes"], first["steps"]["total"]) == (4.5, 1440)
    assert second["steps"]["warm_start"] is None
    text = discovery_cost.EXPERIMENT.page(report)
    assert "not recorded" in text
    assert "leave out the warm start's own" in text


def test_a_refinement_is_paid_for_with_the_warm_start(tmp_path):
    folder = run_folder(tmp_path / "a")
    refinement = {"environment_steps": 500, "seconds": 60.0}
    bandit_file(folder, refinement, environment_steps=1000, seconds=30.0)
    [run] = discovery_cost.collect([folder])["runs"]
    assert run["points"][0] == [0, 1.5, 1500, -400.0]
    assert (run["settings"]["algorithms"], run["planned_generations"]) == ("ppo", 4)


def test_a_start_is_warm_unless_it_is_said_to_be_random(tmp_path):
    folders = [
        run_folder(tmp_path / name, init) for name, init in (("a", "expert"), ("b", "random"))
    ]
    report = discovery_cost.collect(folders)
    assert {run["name"]: run["start"] for run in report["runs"]} == {
        "a": "warm",
        "b": "random",
    }


def test_runs_that_start_elsewhere_are_left_out_and_named(tmp_path):
    kept = run_folder(tmp_path / "kept")
    continued = run_folder(tmp_path / "continued", start="Synthetic-Pendulum-v1")
    mdp = run_folder(tmp_path / "mdp", "random", parameterization="TI")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "config.json").write_text('{"environment": "Pendulum-v1"}')
    report = discovery_cost.collect([kept, continued, mdp, tmp_path / "old"])
    assert [run["name"] for run in report["runs"]] == ["kept"]
    assert [x["name"] for x in report["left_out"]] == ["continued", "mdp", "old"]
    assert "continued, since it continues from another bandit" in discovery_cost.EXPERIMENT.page(
        report
    )
    with pytest.raises(UserError, match="no run starts warm or random"):
        discovery_cost.collect([continued])
    with pytest.raises(UserError, match="no folders"):
        discovery_cost.collect([])


def test_a_figure_of_runs_that_have_no_target_is_empty(tmp_path):
    folder = run_folder(tmp_path / "a", environment="swimmer", backend="generalized")
    report = discovery_cost.collect([folder])
    assert not discovery_cost.EXPERIMENT.figures(report)["discovery_cost"].axes


def test_a_run_in_progress_is_read_up_to_its_last_whole_line(tmp_path):
    folder = run_folder(tmp_path / "a", rows=3)
    for name in ("metrics.jsonl", "timing.jsonl"):
        with (folder / name).open("a") as file:
            file.write('{"generation": 3, "sec')
    # A generation whose seconds are not written yet does not count.
    with (folder / "timing.jsonl").open("w") as file:
        file.write('{"generation": 0, "seconds": 60.0}\n{"generation": 1, "seconds": 30.0}\n')
    report = discovery_cost.collect([folder])
    [run] = report["runs"]
    assert run["generations"] == 2
    assert run["points"] == [[0, 0.0, 0, -400.0]]
    assert "2 of 4" in cells_of(discovery_cost.EXPERIMENT.page(report), "warm")


def test_settings_that_differ_are_told(tmp_path):
    folders = [
        run_folder(tmp_path / "a"),
        run_folder(tmp_path / "b", "random", population_size=64),
    ]
    text = discovery_cost.EXPERIMENT.page(discovery_cost.collect(folders))
    assert "| Pendulum-v1 | population size (32; 64) |" in text


def test_the_figure_has_a_row_an_environment_and_a_line_a_run(tmp_path):
    folders = [
        run_folder(tmp_path / "a"),
        run_folder(tmp_path / "b", "random", seed=4),
        run_folder(tmp_path / "c", "random", environment="CartPole-v1"),
    ]
    report = discovery_cost.collect(folders)
    drawn = discovery_cost.EXPERIMENT.figures(report)["discovery_cost"]
    cartpole, _, minutes, steps = drawn.axes
    assert cartpole.get_title(loc="left") == "CartPole-v1"
    assert len(cartpole.lines) == 2  # one run, the target
    warm, random, target = minutes.lines
    assert list(warm.get_xdata()) == [0.0, 1.5, 4.0]
    assert list(steps.lines[0].get_xdata()) == [0, 220, 440]
    assert list(warm.get_ydata()) == [-400.0, -165.0, -150.0]
    assert (warm.get_linestyle(), random.get_linestyle()) == ("-", "--")
    assert list(target.get_ydata()) == [-170.0, -170.0]


def test_the_command_writes_what_it_can_render_again(tmp_path, capsys):
    folder = run_folder(tmp_path / "a")
    out, docs = tmp_path / "data" / "cost.json", tmp_path / "docs"
    places = ["--out", str(out), "--docs", str(docs)]
    assert discovery_cost.EXPERIMENT.main([str(folder), *places]) == 0
    stored = json.loads(out.read_text())
    assert stored.items() >= discovery_cost.collect([folder]).items()
    assert str(tmp_path) not in out.read_text()
    page, image = docs / "discovery_cost.md", docs / "figures" / "discovery_cost.png"
    before = page.read_text(), image.read_bytes()
    assert before[0] == discovery_cost.EXPERIMENT.page(stored)
    page.unlink()
    assert discovery_cost.EXPERIMENT.main(["--only-render", *places]) == 0
    assert (page.read_text(), image.read_bytes()) == before
    assert discovery_cost.EXPERIMENT.main([str(tmp_path / "nowhere"), *places]) == 2
    assert "not a run" in capsys.readouterr().err


def test_the_interquartile_mean_counts_where_it_is_logged(tmp_path):
    folder = run_folder(tmp_path / "a", "random")
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    lines[0]["mean/fitness_iqm"] = -160.0  # above the target of -170, where the mean is -400
    (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    [run] = discovery_cost.collect([folder])["runs"]
    assert run["points"][0] == [0, 0.0, 0, -160.0]
    assert run["reached"]["generation"] == 0
    assert run["statistic"] == "IQM"
    [other] = discovery_cost.collect([run_folder(tmp_path / "b", "random")])["runs"]
    assert other["statistic"] == "mean"


def test_runs_that_were_read_before_stay_but_where_the_same_folder_is_read_again(tmp_path):
    places = ["--out", str(tmp_path / "cost.json"), "--docs", str(tmp_path)]
    folder = run_folder(tmp_path / "a", rows=3)
    for given in (folder, run_folder(tmp_path / "b", "random")):
        assert discovery_cost.EXPERIMENT.main([str(given), *places]) == 0
    shutil.rmtree(folder)
    assert discovery_cost.EXPERIMENT.main([str(run_folder(folder)), *places]) == 0
    runs = json.loads((tmp_path / "cost.json").read_text())["runs"]
    assert {run["name"]: run["generations"] for run in runs} == {"a": 4, "b": 4}


def test_what_a_search_that_goes_on_starts_from_is_paid_for(tmp_path):
    folder = run_folder(tmp_path / "a", rows=3)
    cost = {"environment_steps": 1000, "seconds": 120.0}
    for name in ("warm_start", "refinement"):
        (folder / f"{name}.json").write_text(json.dumps({"cost": cost}))
    [run] = discovery_cost.collect([folder])["runs"]
    assert run["points"][0][1:3] == [4.0, 2000]
    # One that says nothing of it and is at the target from the start saves no number of times.
    none = run_folder(tmp_path / "b", judged={0: -150.0})
    never = run_folder(tmp_path / "c", "random", judged={0: -400.0}, final=-300.0)
    [found] = discovery_cost.starts(discovery_cost.collect([none, never])["runs"])
    assert found["warm"]["reached"]["steps"] == 0 and found["times"] is None


def test_folders_of_one_name_are_refused(tmp_path, capsys):
    (tmp_path / "x").mkdir()
    folders = [str(run_folder(tmp_path / "a")), str(run_folder(tmp_path / "x" / "a", "random"))]
    places = ["--out", str(tmp_path / "cost.json"), "--docs", str(tmp_path)]
    assert discovery_cost.EXPERIMENT.main([*folders, *places]) == 2
    assert "two of the folders are called a" in capsys.readouterr().err


def test_what_a_warm_start_saves_is_told(tmp_path):
    # The target is -170: the warm run is there before generation 2, after 220 steps, the random one after 440.
    warm = run_folder(tmp_path / "a")
    late = run_folder(tmp_path / "b", "random", judged={0: -400.0, 2: -300.0})
    never = run_folder(tmp_path / "c", "random", judged={0: -400.0}, final=-300.0)

    def rows(*folders):
        page = discovery_cost.EXPERIMENT.page(discovery_cost.collect(folders))
        return page, [line for line in page.splitlines() if line.startswith("| Pendulum-v1 | −170")]

    page, [row] = rows(warm, late, never)
    assert "**From random weights 1 of 1 environments' targets are reached, from a warm" in page
    assert row.startswith("| Pendulum-v1 | −170 | 220 | 440 | 2 | 1.5")
    page, [row] = rows(warm, never)
    assert "**From random weights 0 of 1" in page
    assert "| 220 | not in 440: −300 after 4 generations of 32 | over 2 |" in row
    assert not rows(warm)[1]


def test_a_run_says_where_it_was_computed(tmp_path):
    cpu = {"cores": 2, "processor": "AMD EPYC", "accelerator": "none"}
    gpu = cpu | {"accelerator": "NVIDIA H100 80GB HBM3"}
    folder = run_folder(tmp_path / "a", "random")
    lines = (folder / "timing.jsonl").read_text().splitlines()
    for i, machine in enumerate((gpu, gpu, cpu)):
        lines[i] = json.dumps(json.loads(lines[i]) | {"machine": machine})
    (folder / "timing.jsonl").write_text("\n".join(lines))
    report = discovery_cost.collect([folder])
    assert report["runs"][0]["machines"] == [gpu, cpu]
    assert "4.0 on H100, 2 cores" in discovery_cost.EXPERIMENT.page(report)
    shown = discovery_cost.figure(report).legends[0].get_texts()
    assert "random start on a GPU (1 run)" in [text.get_text() for text in shown]
