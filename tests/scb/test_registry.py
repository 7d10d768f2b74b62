from urllib.error import URLError

import gymnax
import pytest
from gymnax.environments import environment

from scb.environments.brax import BRAX_NAMES, BraxEnvironment
from scb.environments.registry import environment_names, make
from scb.environments.zoo import zoo_names
from scb.errors import UserError, unknown_name


# MNISTBandit downloads its pictures when it is made.
@pytest.mark.parametrize("name", [n for n in gymnax.registered_envs if "MNIST" not in n])
def test_every_gymnax_environment_is_made_by_name(name):
    env, params = make(name)
    assert isinstance(env, environment.Environment)
    assert type(params) is type(env.default_params)


def test_what_cannot_be_fetched_is_told(monkeypatch):
    def make_of_gymnax(name, **arguments):
        raise URLError("no network")

    monkeypatch.setattr(gymnax, "make", make_of_gymnax)
    with pytest.raises(
        UserError, match=r"MNISTBandit-bsuite cannot be made .*no network.* fetched"
    ):
        make("MNISTBandit-bsuite")


def test_brax_environments_are_made_by_name_with_their_backend():
    env, params = make("inverted_pendulum", backend="spring")
    assert isinstance(env, BraxEnvironment)
    assert (env.name, env.backend) == ("inverted_pendulum", "spring")
    assert params.max_steps_in_episode == 1000


def test_the_names_are_gymnaxs_braxs_and_the_zoos():
    names = environment_names()
    assert len(names) == len(set(names))
    assert {"CartPole-v1", *BRAX_NAMES, *zoo_names()} <= set(names)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Pendulum-v2", r"unknown environment 'Pendulum-v2': did you mean Pendulum-v1"),
        ("cartpole", r"unknown environment 'cartpole': did you mean CartPole-v1"),
        ("hoper", r"unknown environment 'hoper': did you mean hopper"),
        ("zzz", r"unknown environment 'zzz': known are .*CartPole-v1, .*hopper, "),
    ],
)
def test_an_unknown_name_is_answered_with_near_ones_or_all(name, message):
    with pytest.raises(UserError, match=message):
        make(name)


@pytest.mark.parametrize("name", ["Pendulum-v1", "hopper"])
def test_arguments_that_an_environment_does_not_take_are_refused(name):
    with pytest.raises(UserError, match=rf"environment '{name}' does not take .*gravity"):
        make(name, gravity=1.0)


def test_near_names_come_closest_first_and_at_most_three():
    # Ratios of difflib: "hopper" for "hoper" 10/11, "popper" 8/11, "copper" 8/11, "chopper" 10/12.
    names = ["zebra", "copper", "popper", "hopper", "chopper"]
    message = str(unknown_name("animal", "hoper", names))
    assert message.startswith("unknown animal 'hoper': did you mean hopper or chopper or ")
    assert message.count(" or ") == 2


def test_an_object_is_no_name_of_an_environment():
    env, _ = make("Synthetic-Pendulum-v1")
    assert repr(env) == "SyntheticBandit('Synthetic-Pendulum-v1')"
    with pytest.raises(UserError, match="is of the class SyntheticBandit: give a name"):
        make(env)
