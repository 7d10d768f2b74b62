"""Environments that nobody registered, by the name of what makes them."""

import enum
import sys

import jax
import numpy as np
import pytest

from lpo.comparison import compare, ppo_spec
from lpo.inner_loop import MetaTrainingConfig
from scb.cli import main
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.environments.registry import check_backend, environment_spec, make
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError
from scb.measurement import Place, as_random
from scb.own import code_of, code_of_names

MODULE = """
import gymnax, jax.numpy as jnp, numpy as np
from flax import struct
from gymnax.environments import environment, spaces
from gymnax.environments.classic_control.pendulum import Pendulum

def alone():
    return Pendulum()

def with_parameters(length=7):
    env, params = gymnax.make("Pendulum-v1")
    return env, params.replace(max_steps_in_episode=length)

def with_physics(backend="hard"):
    env, params = gymnax.make("Pendulum-v1")
    return env, params.replace(g={"soft": 1.0, "hard": 10.0}[backend])

def pole():
    return gymnax.make("CartPole-v1")

class OtherObservations(Pendulum):
    def observation_space(self, params):
        return spaces.Box(-1.0, 1.0, (4,))

class OtherActions(Pendulum):
    def action_space(self, params=None):
        return spaces.Tuple([spaces.Discrete(2), spaces.Discrete(3)])

class OlderStep(Pendulum):
    def step(self, *arguments):
        observation, state, reward, terminated, truncated, info = super().step(*arguments)
        return observation, state, reward, terminated | truncated, info

class NoFinal(Pendulum):
    def step(self, *arguments):
        return *super().step(*arguments)[:5], {}

class OlderReset(Pendulum):
    def reset(self, *arguments):
        return *super().reset(*arguments), {}

class FlatTerminated(Pendulum):
    def step_env(self, *arguments):
        observation, state, reward, terminated, info = super().step_env(*arguments)
        return observation, state, reward, jnp.reshape(terminated, (1,)), info

class NoStep(Pendulum):
    def step(self, *arguments):
        pass

class FourValues(Pendulum):
    def step_env(self, *arguments):
        return super().step_env(*arguments)[:4]

class NoRewards(Pendulum):
    def step_env(self, *arguments):
        observation, state, reward, *others = super().step_env(*arguments)
        return observation, state, reward * jnp.nan, *others

class ManyRewards(Pendulum):
    def step_env(self, *arguments):
        observation, state, reward, *others = super().step_env(*arguments)
        return observation, state, jnp.full(2, reward), *others

class NoParameters(Pendulum):
    @property
    def default_params(self):
        return environment.EnvParams()

@struct.dataclass
class Forgotten(environment.EnvParams):
    g: float = 10.0

class ForgottenLimit(Pendulum):
    @property
    def default_params(self):
        return Forgotten()

def one_step():
    return Pendulum(), Pendulum().default_params.replace(max_steps_in_episode=1)

class NoParts(environment.Environment):
    default_params = Pendulum().default_params
    observation_space, action_space = Pendulum().observation_space, Pendulum().action_space

class FloatTerminated(Pendulum):
    def step_env(self, *arguments):
        *others, terminated, info = super().step_env(*arguments)
        return *others, jnp.float32(terminated), info

class AsksForValues(Pendulum):
    def step_env(self, key, state, action, params):
        if state.theta > 0:
            action = -action
        return super().step_env(key, state, action, params)

class AsNumpy(Pendulum):
    def step_env(self, key, state, action, params):
        return super().step_env(key, state, np.abs(action), params)

class Untimed(Pendulum):
    def step_env(self, *arguments):
        observation, state, *others = super().step_env(*arguments)
        return observation, state.replace(time=arguments[1].time), *others

class Timed(Untimed):
    def is_truncated(self, state, params):
        return state.theta > 3.0

class OtherType(Pendulum):
    def step_env(self, *arguments):
        observation, state, *others = super().step_env(*arguments)
        return observation, state.replace(time=state.time * 1.0), *others

class WholeNumbers(Pendulum):
    def step_env(self, *arguments):
        observation, *others = super().step_env(*arguments)
        return jnp.int32(observation), *others

class ByName(Pendulum):
    def step_env(self, *arguments):
        observation, *others = super().step_env(*arguments)
        return {"angle": observation}, *others

class OwnStep(Untimed):
    def step(self, key, state, action, params):
        observation, state, reward, terminated, info = self.step_env(key, state, action, params)
        info = info | {"final_observation": observation}
        return observation, state, reward, terminated, state.theta > 3.0, info

class InFrames(Pendulum):
    def step_env(self, *arguments):
        observation, state, *others = super().step_env(*arguments)
        return observation, state.replace(time=state.time + 3), *others

@struct.dataclass
class Timeless:
    theta: float = 0.0

class NoTime(Pendulum):
    def reset_env(self, *arguments):
        return super().reset_env(*arguments)[0], Timeless()

    def step_env(self, key, state, action, params):
        return jnp.zeros(3), state, 0.0, jnp.bool_(False), {}

class OwnStepNoTime(NoTime):
    step = OwnStep.step

def no_steps():
    return Pendulum(), Pendulum().default_params.replace(max_steps_in_episode=0)

def forever():
    return Pendulum(), Pendulum().default_params.replace(max_steps_in_episode=float("inf"))

instance = Pendulum()

def endless():
    return Pendulum(), {"g": 10.0}

def wrong():
    return "a pendulum"

number = 3

def broken():
    return 1 + "one"
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module in the working directory, where a program finds it that was not started there."""
    name = f"made_here_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(MODULE)
    (tmp_path / f"{name}_broken.py").write_text("import nothing_of_this_name")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [x for x in sys.path if x not in ("", str(tmp_path))])
    return name


def test_an_environment_is_what_the_factory_returns(module):
    env, params = make(f"{module}:alone")
    assert env.name == "Pendulum-v1" and params.max_steps_in_episode == 200
    env, params = make(f"{module}:with_parameters")
    assert params.max_steps_in_episode == 7
    _, params = make(f"{module}:with_parameters", length=9)
    assert params.max_steps_in_episode == 9
    spec = environment_spec(f"{module}:with_parameters")
    assert spec.episode_limit == 7 and spec.bandit == f"Synthetic-{module}-with_parameters"
    assert spec.random_return() < -5


def test_an_environment_may_say_that_its_episodes_have_one_step(module):
    assert make(f"{module}:one_step")[1].max_steps_in_episode == 1


def test_an_environment_itself_is_taken_as_well_as_what_makes_it(module):
    env, params = make(f"{module}:instance")
    assert env.name == "Pendulum-v1" and params.max_steps_in_episode == 200


CODE = """
import jax.numpy as jnp
from gymnax.environments.classic_control.pendulum import Pendulum
from gymnax.wrappers.purerl import FlattenObservationWrapper
import helper

PULL = 2.0

class Harder(Pendulum):
    def step_env(self, key, state, action, params):
        observation, state, reward, *others = super().step_env(key, state, action, params)
        return observation, state, PULL * reward - helper.cost(action), *others

def made(length=7):
    env = Harder()
    return env, env.default_params.replace(max_steps_in_episode=length)

instance = FlattenObservationWrapper(FlattenObservationWrapper(Harder()))

def held():
    return instance, instance.default_params
"""
HELPER = "def cost(action):\n    return 0.1 * abs(action.sum())\n"


@pytest.mark.parametrize("attribute", ["made", "Harder", "instance", "held"])
@pytest.mark.parametrize(
    ("before", "after", "counts"),
    [
        ("PULL = 2.0", "PULL = 2.0  # mine", False),
        ("PULL = 2.0", "UNUSED = PULL = 2.0", False),
        ("PULL = 2.0", "PULL = 3.0", True),
        ("PULL * reward", "reward", True),
        ("0.1 * abs", "0.2 * abs", True),  # of the module that it imports
    ],
)
def test_what_an_environment_computes_is_its_code(
    tmp_path, monkeypatch, before, after, counts, attribute
):
    found = []
    for folder, edit in (("a", str), ("b", lambda text: text.replace(before, after))):
        (tmp_path / folder).mkdir()
        for name, text in (("edited", CODE), ("helper", HELPER)):
            (tmp_path / folder / f"{name}.py").write_text(edit(text))
            monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.syspath_prepend(tmp_path / folder)
        found.append(code_of_names([f"edited:{attribute}", "Pendulum-v1"]))
    one, other = found
    assert one.keys() == {f"edited:{attribute}"}
    assert (one != other) == counts


class Gait(enum.Enum):
    WALK, RUN, HOP = range(3)


def test_code_is_the_same_whatever_the_order_of_a_set_and_whatever_it_holds():
    def made(gaits, random_key, around):
        around["itself"] = around
        return code_of(lambda: (gaits, random_key, around))

    one, same, other = (
        made(gaits, jax.random.key(seed), {})
        for gaits, seed in (
            (dict.fromkeys([Gait.WALK, Gait.RUN]), 0),
            (dict.fromkeys([Gait.RUN, Gait.WALK]), 0),
            (dict.fromkeys([Gait.WALK, Gait.RUN]), 1),
        )
    )
    assert one == same != other


def test_code_that_is_nowhere_and_a_librarys_is_nobodys_own(module):
    names = ["Pendulum-v1", "nowhere.at_all:make", "C:/nothing", f"{module}:instance"]
    assert code_of_names([*names, "gymnax.environments.misc.reacher:Reacher"]) == {}


def test_what_was_begun_with_other_code_does_not_go_on(module, tmp_path, monkeypatch):
    name = f"{module}:with_parameters"
    assert DiscoveryConfig(name).checksums().keys() == {name}
    config = MetaTrainingConfig(tasks=(name,))
    assert config.checksums().keys() == {name}
    spec = ppo_spec(name, 64, {"num_envs": 2, "num_steps": 8, "num_minibatches": 1})

    def rows(seeds):
        return compare(name, ["ppo"], seeds, spec, points=1, episodes=1, rows=tmp_path / "a.jsonl")

    rows([0])
    monkeypatch.setattr(
        "scb.measurement.code_of_names", lambda names: dict.fromkeys(names, "other")
    )
    with pytest.raises(UserError, match="under another configuration"):
        rows([0, 1])


def test_the_physics_that_a_factory_takes_is_part_of_the_place(module):
    name = f"{module}:with_physics"
    soft, hard = (Place.named(name, backend) for backend in ("soft", "hard"))
    assert (soft.backend, hard.backend, Place.named(name).backend) == ("soft", "hard", None)
    assert (soft.params.g, hard.params.g) == (1.0, 10.0)
    check_backend("soft", [name, "Pendulum-v1"])
    with pytest.raises(UserError, match="none has a choice: leave it out"):
        check_backend("soft", ["Pendulum-v1"])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere.at_all:make", "cannot be imported .No module named 'nowhere'"),
        ("{}:other", "cannot be imported .*has no attribute 'other'"),
        ("{}_broken:make", "cannot be imported .No module named 'nothing_of_this_name'"),
        (
            "{}:OtherObservations",
            r"shape \(3,\) from reset, where its observation_space says \(4,\)",
        ),
        ("{}:OtherActions", "has a gymnax.environments.spaces.Tuple of actions: one Box or Disc"),
        ("{}:OlderStep", "returns 5 of step, where gymnax 1.x returns observation, state, reward"),
        ("{}:NoFinal", "returns an info without final_observation from step"),
        ("{}:OlderReset", "returns 3 of reset, where gymnax 1.x returns observation, state: "),
        ("{}:NoStep", "returns 1 of step, where gymnax 1.x returns"),
        ("{}:FourValues", "returns 4 of step_env, where gymnax 1.x returns observation, state, re"),
        ("{}:ManyRewards", r"rewards of shape \(2,\)"),
        (
            "{}:NoParameters",
            "parameters whose max_steps_in_episode is gymnax's own, so that its episodes end after",
        ),
        (
            "{}:ForgottenLimit",
            "parameters whose max_steps_in_episode is gymnax's own, so that its episodes end after",
        ),
        ("{}:NoParts", "lacks reset_env or step_env, which gymnax's own reset and step call"),
        ("{}:FloatTerminated", "returns a terminated of the type float32 from step_env: return a"),
        (
            "{}:FlatTerminated",
            r"returns a terminated of shape \(1,\) from step_env: return one bool",
        ),
        ("{}:AsksForValues", "asks for a value where JAX only has a shape .*jax.lax.cond"),
        ("{}:AsNumpy", "asks for a value where JAX only has a shape .*jnp in place of numpy"),
        (
            "{}:Untimed",
            "returns a state whose time is what it was, from step_env, and episodes end",
        ),
        ("{}:OtherType", r"state whose time is int32\[\] from reset_env and float32\[\] from"),
        ("{}:WholeNumbers", r"observation that is float32\[3\] from reset_env and int32\[3\] from"),
        ("{}:ByName", r"an observation that is float32\[3\] from reset_env and something else fr"),
        ("{}:NoTime", "has a state without time, the steps of its episode: give it that field"),
        ("{}:OwnStepNoTime", "has a state without time, the steps of its episode: give it that"),
        ("{}:no_steps", "has a max_steps_in_episode of 0, after which an episode ends"),
        ("{}:forever", "of inf, after which an episode ends: it must be at least 1, and below"),
        ("{}:endless", "without max_steps_in_episode"),
        ("{}:wrong", "returned a str: it must return a gymnax"),
        ("{}:number", "is a int, which cannot be called: give a class or a function"),
    ],
)
def test_what_is_no_factory_is_refused(module, name, message):
    with pytest.raises(UserError, match=message):
        make(name.format(module))


@pytest.mark.parametrize("name", ["Timed", "OwnStep", "InFrames"])
def test_an_environment_may_end_its_episodes_by_something_else_than_steps(module, name):
    assert make(f"{module}:{name}")[1].max_steps_in_episode == 200


def test_where_nobody_earns_a_number_the_environment_is_told(module):
    name = f"{module}:NoRewards"
    message = r"random actions earn nan in .*NoRewards: see that its rewards are finite"
    with pytest.raises(UserError, match=message):
        as_random(np.array([np.nan]), Place.named(name))
    # Before a search for an expert, or a generation, that could find nothing.
    for init in ("expert", "random"):
        problem = BanditDiscovery(DiscoveryConfig(environment=name, init=init))
        with pytest.raises(UserError, match=message):
            problem.search(quiet=True)


def test_a_bug_inside_of_a_factory_is_not_taken_for_wrong_arguments(module):
    with pytest.raises(TypeError, match="unsupported operand"):
        make(f"{module}:broken")
    with pytest.raises(UserError, match=r"does not take the arguments {'length': 3}"):
        make(f"{module}:broken", length=3)


@pytest.mark.slow
def test_a_bandit_is_discovered_for_it_and_says_what_its_returns_are_to_be_compared_with(
    module, tmp_path, capsys, monkeypatch, small_agents
):
    monkeypatch.setattr("scb.commands.judge_all", lambda *_: {})  # it takes the longest
    name = f"{module}:pole"
    flags = ["--population-size=2", "--generations=1", "--mean-evaluations=2", "--judge-agents=2"]
    flags += ["--agents-per-candidate=1", "--evaluation-episodes=1", "--judge-episodes=1"]
    flags += ["--expert-steps=4000", "--fit-steps=10", "--algorithms=ppo", "--expert=ppo"]
    out = tmp_path / "run"
    status = main(["discover", f"--environment={name}", *flags, f"--out={out}"])
    said = capsys.readouterr()
    assert status == 0, said.err
    assert f"to compare with, on {name}: random actions: 2" in said.out
    assert "the expert that the bandit was fitted to, in 20 episodes: " in said.out
    assert "fitting a bandit to an expert of " in said.err
    path = out / f"Synthetic-{module}-pole.npz"
    assert bandit_metadata(str(path))["config"]["evaluation_environment"] == name
    assert environment_spec(str(path)).evaluation_environment == name
