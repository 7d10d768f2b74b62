"""Environments with equal contents are one key of the programs that train in them."""

import jax.numpy as jnp
import pytest
from gymnax.environments.classic_control.pendulum import Pendulum

from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.environments.alike import representative
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import load_synthetic
from scb.measurement import Place, _program, measure


class Weighted(Pendulum):
    def __init__(self, **attributes):
        super().__init__()
        for name, value in attributes.items():
            setattr(self, name, value)


NAMES = ("Pendulum-v1", "MountainCar-v0", "Breakout-MinAtar", "Synthetic-Pendulum-v1", "hopper")


@pytest.mark.parametrize("name", NAMES)
def test_what_is_made_twice_is_alike(name):
    one, other = Place.named(name).env, Place.named(name).env
    assert one is not other
    assert representative(other) is representative(one)
    assert type(representative(one)) is type(other)


ATTRIBUTES = (
    {"mass": 1},
    {"mass": 1.0},
    {"mass": True},
    {"weight": 1},
    {"mass": jnp.arange(3)},
    {"mass": jnp.arange(3.0)},
    {"mass": jnp.arange(3)[:, None]},
    {"mass": {"a": jnp.arange(3), "b": 1}},
    {"mass": {"a": jnp.arange(3), "b": 2}},
    {"mass": [jnp.arange(3), 1]},
    {"mass": (jnp.arange(3), 1)},
    {"mass": object()},
    {"inner": Pendulum()},
    {},
)


def test_what_differs_in_an_attribute_or_its_type_is_not():
    made = [Weighted(**x) for x in ATTRIBUTES] + [Pendulum()]
    seen = [representative(env) for env in made]
    assert len({id(x) for x in seen}) == len(made)
    again = [representative(Weighted(**x)) for x in ATTRIBUTES]
    assert all(x is y for x, y in zip(again, seen, strict=False))
    # Of two sets equality could be told, but not kept.
    one, other = Weighted(mass={1, 2}), Weighted(mass={1, 2})
    assert representative(one) is one and representative(other) is other


def test_bandits_of_other_weights_spaces_or_settings_are_not():
    own = load_synthetic("Synthetic-Pendulum-v1")
    size, space, weights = own.observation_size, own.action_space(), own.default_params.weights
    doubled = {
        **weights,
        "reward": {k: {n: 2 * x for n, x in v.items()} for k, v in weights["reward"].items()},
    }

    def made(space=space, config=own.config, weights=weights, name=own.name):
        return representative(SyntheticBandit(size, space, config, weights, name))

    assert made() is made()
    wider = type(space)(2 * space.low, 2 * space.high, space.shape, space.dtype)
    others = [
        made(space=wider),
        made(config=BanditConfig(activation="relu")),
        made(weights=doubled),
        made(weights=None),
        made(name="another"),
    ]
    assert len({id(x) for x in [made(), *others]}) == 6


def test_an_environment_that_is_made_again_is_trained_in_by_the_same_program():
    def earned(rate):
        config = PPOConfig(num_envs=2, total_steps=32, num_steps=8, num_epochs=1, num_minibatches=1)
        spec = AgentSpec("ppo", config, PPOHyperparameters(learning_rate=rate))
        place = Place.named("Pendulum-v1")
        return [row["return"] for row in measure(spec, place, place, [3], episodes=2)]

    first, before = earned(0.001), _program.cache_info()
    other, again = earned(0.1), earned(0.001)
    after = _program.cache_info()
    assert (after.hits, after.misses) == (before.hits + 2, before.misses)
    assert first == again != other
