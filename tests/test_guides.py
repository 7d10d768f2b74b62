"""The code in the guides runs as it stands."""

import re
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

from examples.own_objective import TwoSided
from scb.environments.registry import environment_spec, make
from scb.environments.spec import EnvironmentSpec

DOCS = Path(__file__).parents[1] / "docs"


def blocks(page):
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


def block(page):
    (code,) = blocks(page)
    return code


def test_an_agent_is_kept_and_acts_in_gymnasiums_environment(tmp_path, capsys):
    kept, *_ = blocks("agents.md")
    exec(compile(kept.replace("/tmp/agent", str(tmp_path / "agent")), "agents.md", "exec"), {})
    assert -1000 < float(capsys.readouterr().out) < 0


@pytest.mark.slow
def test_agents_of_several_learning_rates_train_at_once(capsys):
    _, vmapped, _ = blocks("agents.md")
    exec(compile(vmapped, "agents.md", "exec"), {})
    returns = [float(x) for x in capsys.readouterr().out.strip(" []\n").split()]
    assert len(set(returns)) == 4 and min(returns) > -1600 and max(returns) < -50


@pytest.mark.slow
def test_agents_act_as_one(capsys):
    *_, as_one = blocks("agents.md")
    exec(compile(as_one, "agents.md", "exec"), {})
    mean, worst, together = map(float, capsys.readouterr().out.split())
    assert worst < mean < together < 0


@pytest.mark.slow
def test_objectives_are_compared_under_settings_of_ones_own(capsys):
    *_, code = blocks("own_objective.md")
    code = code.replace("20_000", "2_000").replace("range(10)", "range(2)")
    exec(compile(code, "own_objective.md", "exec"), {})
    assert "(n=2)" in capsys.readouterr().out


@pytest.mark.slow
def test_an_objective_of_ones_own_is_compared_and_its_family_is_the_examples(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    compared, family, _ = blocks("own_objective.md")
    small = {"range(10)": "range(2)", "policy_output_scale=0.01": "total_steps=10_000"}
    for full, less in small.items():
        assert full in compared
        compared = compared.replace(full, less)
    # Source is looked for in a file, as in a module or a notebook.
    (tmp_path / "guide.py").write_text(compared)
    exec(compile(compared, "guide.py", "exec"), {"__name__": "guide"})
    assert "(n=2)" in capsys.readouterr().out and (tmp_path / "spo.png").stat().st_size
    assert (tmp_path / "spo.jsonl").exists()
    shown: dict = {"__name__": "guide"}
    exec(compile(family, "guide.py", "exec"), shown)
    one, same = shown["TwoSided"](), TwoSided()
    given = jnp.array([-0.5, 0.3]), jnp.array([1.0, -2.0]), jnp.zeros(2)
    strengths = {"log_strength": jnp.log(jnp.array([1.0, 3.0]))}
    assert (one(strengths, *given) == same(strengths, *given)).all()


def test_an_environment_of_ones_own_is_made(tmp_path, monkeypatch):
    (tmp_path / "point_of_the_guide.py").write_text(block("own_environment.md"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    env, params = make("point_of_the_guide:Point")
    assert env.action_space(params).shape == (1,) and params.max_steps_in_episode == 50
    # A random walk from somewhere between -1 and 1.
    spec = environment_spec("point_of_the_guide:Point")
    assert -40 < spec.random_return() < -10 and spec.episode_limit == 50


def test_the_guide_says_what_a_bandit_of_ones_own_is_called():
    guide = (DOCS / "own_environment.md").read_text()
    (environment,) = set(re.findall(r"--environment (my_package\S+)", guide))
    names = set(re.findall(r"Synthetic-my_package\S*?(?=\.npz)", guide))
    assert names == {EnvironmentSpec(environment, "custom", make).bandit}
