"""Both ways are timed in turn, from the same states to the same states, and the page says the ratios."""

import json

import pytest

from experiments import brax_speed
from experiments.brax_speed import Options, rollout


@pytest.mark.slow
def test_a_ratio_is_of_the_same_steps(tmp_path):
    flags = ["--repeats", "2", "--steps", "2", "--num-envs", "4"]
    flags += ["--environments", "inverted_pendulum", "--out", str(tmp_path / "speed.json")]
    assert brax_speed.EXPERIMENT.main(flags) == 0
    (cell,) = json.loads((tmp_path / "speed.json").read_text())["environments"].values()
    assert len(cell["ratios"]) == 2 and min(cell["ratios"]) > 0
    page = (tmp_path / "brax_speed.md").read_text()
    assert "| 4 environments |" in page and "| inverted_pendulum | " in page


def test_a_rollout_ends_where_the_actions_lead():
    class Counter:
        action_size = 1

        def reset(self, key):
            import jax.numpy as jnp
            from brax.envs import State

            return State(None, jnp.zeros(1), jnp.zeros(()), jnp.zeros(()))

        def step(self, state, action):
            return state.replace(obs=state.obs + abs(action))

    ends = rollout(Counter(), Options(num_envs=3, steps=5))()
    assert ends.shape == (3, 1) and (ends > 0).all() and (ends < 5).all()
