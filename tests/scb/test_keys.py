"""Random keys come from scb.keys, and no two draws of a run use the same one."""

import re
from dataclasses import asdict, replace

import jax
import numpy as np
import pytest

from lpo.comparison import learning_curves
from lpo.drifts import LearnedDrift
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import meta_train
from lpo.objectives import load_objective
from scb.agents.spec import environment_agent
from scb.discovery import DiscoveryConfig, discover
from scb.environments.registry import EnvironmentSpec
from scb.environments.synthetic import BanditConfig
from scb.evolution import EvolutionConfig
from scb.judgement import judge
from scb.keys import key_at, named_key, root_key, split_key
from scb.measurement import Place
from scb.seeds import validation
from scb.warm_start import WarmStartConfig
from tests.recording import recorded
from tests.scb.test_discovery import TINY, TINY_DQN
from tests.scb.test_imports import MODULES, ROOT

# rejax's side of the benchmark runs where this project is not installed.
ELSEWHERE = {"scb/keys.py", "experiments/peers/rejax_peer.py"}


def data(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


@pytest.mark.parametrize("package", MODULES)
def test_keys_are_made_in_one_module(package):
    made = re.compile(
        r"random\.(key|PRNGKey|split|fold_in|wrap_key_data|clone)\b|from jax\.random|from jax import random"
    )
    for path in MODULES[package]:
        name = str(path.relative_to(ROOT))
        assert name in ELSEWHERE or not made.search(path.read_text()), name


def test_a_position_is_a_part_of_a_split_which_is_why_no_key_has_both():
    key = root_key(3)
    assert [data(k) for k in split_key(key, 4)] == [data(key_at(key, i)) for i in range(4)]


def test_a_longer_split_begins_with_a_shorter_one():
    key = root_key(3)
    assert [data(k) for k in split_key(key, 5)][:4] == [data(k) for k in split_key(key, 4)]


def test_named_keys_differ_from_each_other_and_from_every_position():
    key = root_key(0)
    named = {data(named_key(key, role)) for role in ("ppo", "sac", "expert", "")}
    positions = {data(k) for k in split_key(key, 10_000)} | {data(key_at(key, 2**31 - 1))}
    assert len(named) == 4 and not named & positions and data(key) not in named


def test_a_name_means_the_same_key_in_every_process():
    # sha256("expert") begins with c7d25387, whose first bit is set already.
    assert data(named_key(root_key(0), "expert")) == data(key_at(root_key(0), 0xC7D25387))


# -- the keys of whole runs
# ------------------------------------------------------------------------------------------------


def test_a_key_that_is_used_twice_is_seen_inside_a_compiled_program():
    def twice(key):
        key_first, key_second = split_key(key)
        first = jax.random.normal(key_first)
        return first + jax.random.normal(key_second) + jax.random.uniform(key_at(key, 0))

    with recorded() as record:
        jax.jit(jax.vmap(twice))(split_key(root_key(7), 3))
    assert record.seeds == {7}
    assert record.draws() == 3 * 2
    # A key that is split and indexed, and its first part, drawn from at two places.
    (both, drawn) = sorted(record.shared(), key=lambda places: places[0][1], reverse=True)
    assert [kind for _, kind in both] == ["split", "fold_in"] or [kind for _, kind in both] == [
        "fold_in",
        "split",
    ]
    assert [kind for _, kind in drawn] == ["draw", "draw"]


# No warm start, two algorithms.
DISCOVERY = DiscoveryConfig(
    environment="CartPole-v1",
    bandit=BanditConfig(hidden_size=4),
    algorithms=("ppo", "dqn"),
    configs={"ppo": asdict(TINY), "dqn": asdict(TINY_DQN)},
    agents_per_candidate=2,
    evaluation_episodes=1,
    init="random",
    evolution=EvolutionConfig(population_size=2, num_generations=1, mean_evaluations=2),
)


# What shares keys on purpose does so at one place in the code: all candidates of a generation, the judgements
# of a mean, sampled and most likely actions of one agent. A key at two places, or split and drawn from, is a mistake.
@pytest.mark.slow
def test_a_discovery_uses_every_key_at_one_place():
    with recorded() as record:
        discover(DISCOVERY, quiet=True)
    assert record.draws() > 100
    assert record.seeds == {0}
    assert record.shared() == []


@pytest.mark.slow
def test_a_discovery_from_a_warm_start_and_its_judgement_use_every_key_at_one_place(monkeypatch):
    # An expert of one generation may earn less than random actions, which would be refused.
    monkeypatch.setattr(EnvironmentSpec, "random_return", lambda *arguments: 0.0)
    warm_start = WarmStartConfig(
        "q", expert="evolution", expert_generations=1, num_states=8, horizon=4, fit_steps=2
    )
    config = replace(DISCOVERY, init="expert", reward_std=1.0, warm_start=warm_start)
    with recorded() as record:
        problem, outcome = discover(config, quiet=True)
        place, weights = Place.named("CartPole-v1"), outcome.mean
        judge(problem.specs["ppo"], problem.bandit, weights, place, validation()[0], 2, 1)
    assert record.draws() > 1000
    assert record.seeds == {0, 30_000}
    assert record.shared() == []


@pytest.mark.slow
def test_a_meta_training_and_its_evaluation_use_every_key_at_one_place():
    config = MetaTrainingConfig(
        tasks=("Synthetic-Pendulum-v1", "Synthetic-CartPole-v1"),
        drift=LearnedDrift(hidden_size=4),
        contexts=20,
        horizons=(0.5, 1.0),
        agents_per_candidate=2,
        evaluation_episodes=2,
        evolution=EvolutionConfig(population_size=2, num_generations=1, mean_evaluations=2),
    )
    with recorded() as record:
        outcome = meta_train(config, quiet=True)
        outcome.validate(outcome.mean)
        spec = replace(environment_agent("ppo", "Pendulum-v1"), config=TINY)
        learning_curves(
            "Pendulum-v1", load_objective("ppo"), [7, 8], spec=spec, points=1, episodes=1
        )
    assert record.draws() > 1000
    assert record.seeds == {0, 7, 8, 30_000}
    assert record.shared() == []
