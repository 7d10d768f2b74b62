"""Pages to turn: their figures hold what bandit and objective say, and a browser shows them without the web."""

import base64
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

from lpo import cli as lpo_cli
from lpo.objectives import load_objective
from lpo.update_regions import analyze
from scb import cli as scb_cli
from scb.environments.zoo import load_bandit
from tests.site import BROWSERS


def figures(page):
    """The figures of a page, as Plotly's script gets them: [(traces, layout)]."""
    read = json.JSONDecoder().raw_decode
    found = []
    for start in re.finditer(r'Plotly\.newPlot\(\s*"figure-\d+",\s*', page):
        traces, end = read(page, start.end())
        layout, _ = read(page, re.compile(r"[,\s]*").match(page, end).end())
        found.append((traces, layout))
    return found


def array(values):
    """An array as Plotly writes it, in base64 with its type and shape."""
    if isinstance(values, dict):
        flat = np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
        return flat.reshape([int(n) for n in values.get("shape", "-1").split(",")])
    return np.asarray(values)


@pytest.fixture(scope="module")
def bandit_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explain")
    arguments = ["explain", "Synthetic-MountainCar-v0", "--episodes", "2", "--html"]
    assert scb_cli.main([*arguments, "--out", str(folder)]) == 0
    return folder / "explain.html"


@pytest.fixture(scope="module")
def objective_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("show")
    assert lpo_cli.main(["show", "lpo-pendulum", "--html", "--out", str(folder)]) == 0
    return folder / "show.html"


def test_the_surface_is_the_bandits_reward_of_each_action(bandit_page):
    (traces, layout), (best_actions, _) = figures(bandit_page.read_text())
    (slider,) = layout["sliders"]
    assert [step["label"] for step in slider["steps"]] == ["the best", "0", "1", "2"]
    x, y = (array(traces[0][axis]) for axis in "xy")
    states = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1).astype(np.float32)
    bandit = load_bandit("Synthetic-MountainCar-v0")
    reward = jax.jit(jax.vmap(bandit.mean_reward, (0, None, None)))
    expected = np.stack([reward(states, a, bandit.default_params) for a in range(3)])
    drawn = [array(step["args"][0]["z"][0]).ravel() for step in slider["steps"]]
    np.testing.assert_allclose(drawn, [expected.max(0), *expected], atol=1e-3)
    assert array(best_actions[0]["z"]).ravel() == pytest.approx(expected.argmax(0))


def test_the_curves_are_what_the_objectives_do_at_each_advantage(objective_page):
    (traces, layout), _ = figures(objective_page.read_text())
    assert [t["name"] for t in traces] == 2 * ["ppo", "dpo", "lpo-pendulum"]
    (slider,) = layout["sliders"]
    ratios = array(traces[2]["x"])
    step = next(s for s in slider["steps"] if s["label"] == "-2")
    found = analyze(load_objective("lpo-pendulum"), 0.5, np.log(ratios), np.array([-2.0]))
    gain, share = (array(step["args"][0]["y"][i]) for i in (2, 5))
    np.testing.assert_allclose(gain, -2.0 * (ratios - 1.0) - found.drift[0], atol=1e-3)
    np.testing.assert_allclose(share, found.relative[0].clip(-1.5, 2.5), atol=1e-3)


def test_what_is_shown_is_also_in_numbers(objective_page, capsys, tmp_path):
    said = json.loads((objective_page.parent / "show.json").read_text())["objectives"]
    assert [x["objective"] for x in said] == ["ppo", "dpo", "lpo-pendulum"]
    assert said[0]["stops"] == {
        "+1": pytest.approx(1.2, abs=0.01),
        "-1": pytest.approx(0.8, abs=0.01),
    }
    assert lpo_cli.main(["show", "ppo", "--beside", "--out", str(tmp_path)]) == 0
    assert re.search(r"^ppo: flat \d+%, free \d+%$", capsys.readouterr().out, re.M)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["show.json", "show.png"]


def test_objectives_of_runs_are_shown_apart_by_their_folders(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lpo.showing.drift_and_gradient", lambda *_: Figure())

    def copied(folder):
        folder.mkdir(parents=True)
        zoo = Path(lpo_cli.__file__).with_name("zoo")
        for kind in (".npz", ".json"):
            shutil.copy(zoo / f"lpo-pendulum{kind}", folder / f"objective{kind}")
        return folder / "objective.npz"

    for name in ("a", "b"):
        copied(Path("runs", name))
        assert lpo_cli.main(["show", f"runs/{name}/objective", "--beside"]) == 0
    assert sorted(x.name for x in Path("runs/show").iterdir()) == ["a", "b"]
    # Two of one name: it is told apart by its path, which is no folder's name.
    other = copied(Path("others/a").absolute())
    assert lpo_cli.main(["show", str(other), "--beside", "runs/a/objective"]) == 0
    assert [x.name for x in other.parent.iterdir() if x.is_dir()] == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("dop", "did you mean dpo?"),
        ("ppo --beside dop", "did you mean dpo?"),
        ("ppo --progress 2", "--progress is 2.0: it is a fraction of training, from 0 to 1."),
    ],
)
def test_show_refuses_what_makes_no_sense(arguments, said, capsys, tmp_path):
    command = ["show", *arguments.split(), "--out", str(tmp_path / "a")]
    assert lpo_cli.main(command) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("main", "arguments"),
    [(lpo_cli.main, ["show", "ppo"]), (scb_cli.main, ["explain", "Synthetic-Pendulum-v1"])],
)
def test_without_plotly_a_sentence_says_what_to_install(
    main, arguments, monkeypatch, capsys, tmp_path
):
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    assert main([*arguments, "--html", "--out", str(tmp_path / "a")]) == 2
    assert "install the extra `html`" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
@pytest.mark.parametrize("page", ["bandit_page", "objective_page"])
def test_a_browser_shows_the_page_without_the_web(page, request):
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser")
    path = request.getfixturevalue(page)
    command = [browser, "--headless", "--no-sandbox", "--enable-unsafe-swiftshader"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=20000"]
    shown = subprocess.run(
        [*command, "--dump-dom", path.as_uri()], capture_output=True, text=True, check=True
    ).stdout
    # Plotly's script adds these to what the file says: it ran, and drew both figures and the slider.
    assert len(re.findall(r'class="[^"]*js-plotly-plot', shown)) == 2
    assert shown.count("<canvas") >= 1 and "slider-container" in shown
