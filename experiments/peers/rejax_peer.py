"""Times rejax in a bandit; run by `experiments.benchmark` under a python that has rejax 0.1.3 and gymnax 0.0.9.

    python rejax_peer.py JOB.json

It imports nothing of this project, and prints as JSON the seconds an agent of each repeat and every
agent's mean return in the job's environment.
"""

# mypy: ignore-errors
import json
import sys
import time
import warnings

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import rejax
from flax import struct
from gymnax.environments import environment, spaces
from rejax.evaluate import evaluate

LATENTS = {
    "normal": lambda key, n: jax.random.normal(key, (n,)),
    "uniform": lambda key, n: jax.random.uniform(key, (n,)),
    "categorical": lambda key, n: jax.nn.one_hot(jax.random.randint(key, (), 0, n), n),
    "softmax_categorical": lambda key, n: jax.nn.one_hot(
        jax.random.categorical(key, jnp.arange(1.0, n + 1.0)), n
    ),
}


@struct.dataclass
class State:
    context: jax.Array
    time: int


class Bandit(environment.Environment):
    """The bandit under gymnax 0.0.9's interface (a step returns five values)."""

    def __init__(self, weights, activation, latent, action_space):
        super().__init__()
        self.arrays = {k: jnp.asarray(v) for k, v in np.load(weights, allow_pickle=False).items()}
        self.activation = jax.nn.relu if activation == "relu" else jnp.tanh
        self.latent = latent
        self.latent_size = self.arrays["initial_state/Dense_0/kernel"].shape[0]
        self.observation_size = self.arrays["initial_state/Dense_1/bias"].shape[0]
        self.discrete = action_space["type"] == "discrete"
        if self.discrete:
            self.space = spaces.Discrete(action_space["n"])
        else:
            # One number a bound, as in gymnax's own environments: rejax hashes them.
            (low,), (high,) = set(action_space["low"]), set(action_space["high"])
            self.space = spaces.Box(low, high, tuple(action_space["shape"]))

    def _network(self, name, inputs):
        hidden = (
            inputs @ self.arrays[f"{name}/Dense_0/kernel"] + self.arrays[f"{name}/Dense_0/bias"]
        )
        hidden = self.activation(hidden)
        return hidden @ self.arrays[f"{name}/Dense_1/kernel"] + self.arrays[f"{name}/Dense_1/bias"]

    def reset_env(self, key, params):
        latent = LATENTS[self.latent](key, self.latent_size)
        context = self._network("initial_state", latent)
        return context, State(context, 0)

    def step_env(self, key, state, action, params):
        if self.discrete:
            action = jax.nn.one_hot(action, self.space.n)
        else:
            action = jnp.reshape(action, self.space.shape)
            action = jnp.clip(action, self.space.low, self.space.high)
        reward = self._network("reward", jnp.concatenate([state.context, action]))[0]
        return state.context, State(state.context, state.time + 1), reward, jnp.bool_(True), {}

    def action_space(self, params=None):
        return self.space

    def observation_space(self, params=None):
        return spaces.Box(-jnp.inf, jnp.inf, (self.observation_size,))


class DDPG(rejax.TD3):
    """rejax has none of its own, and its TD3 insists on two critics: this is that update with one."""

    def update_critic(self, ts, minibatch):
        next_action = self.actor.apply(ts.actor_target_params, minibatch.next_obs)
        (next_q,) = self.vmap_critic(ts.critic_target_params, minibatch.next_obs, next_action)
        target = minibatch.reward + (1 - minibatch.done) * self.gamma * next_q

        def loss(params):
            (q,) = self.vmap_critic(params, minibatch.obs, minibatch.action)
            return optax.l2_loss(q, target).mean()

        gradient = jax.grad(loss)(ts.critic_ts.params)
        return ts.replace(critic_ts=ts.critic_ts.apply_gradients(grads=gradient))


ALGORITHMS = {"PPO": rejax.PPO, "SAC": rejax.SAC, "TD3": rejax.TD3, "DQN": rejax.DQN, "DDPG": DDPG}


def make_act(algorithm, state):
    """How a trained agent acts: as in rejax, but DQN without its leftover of random actions."""
    if isinstance(algorithm, rejax.DQN):
        return lambda obs, _: jnp.argmax(algorithm.agent.apply(state.q_ts.params, obs[None])[0])
    return algorithm.make_act(state)


def main() -> None:
    # gymnax 0.0.9 asks for 64-bit integers, and gets 32.
    warnings.filterwarnings("ignore", message="Explicitly requested dtype")
    with open(sys.argv[1]) as file:
        job = json.load(file)
    env = Bandit(**job["bandit"])
    algorithm = ALGORITHMS[job["algorithm"]].create(
        env=env,
        env_params=env.default_params,
        skip_initial_evaluation=True,
        eval_freq=job["settings"]["total_timesteps"],
        **job["settings"],
    )
    # Training alone is timed, here as there.
    algorithm = algorithm.replace(eval_callback=lambda *_: ())
    keys = jax.random.split(jax.random.PRNGKey(0), job["population"])
    train = jax.jit(jax.vmap(algorithm.train)).lower(keys).compile()
    real, real_params = gymnax.make(job["environment"])

    def mean_return(state, key):
        act = make_act(algorithm, state)
        return evaluate(act, key, real, real_params, job["episodes"])[1].mean()

    evaluate_all = jax.jit(jax.vmap(mean_return))
    seconds, returns = [], []
    for repeat in range(1, job["repeats"] + 1):
        keys = jax.random.split(jax.random.PRNGKey(repeat), job["population"])
        start = time.perf_counter()
        states, _ = jax.block_until_ready(train(keys))
        seconds.append((time.perf_counter() - start) / job["population"])
        key = jax.random.fold_in(jax.random.PRNGKey(repeat), job["population"])
        keys = jax.random.split(key, job["population"])
        returns += evaluate_all(states, keys).tolist()
    print(json.dumps({"seconds": seconds, "returns": returns}))


if __name__ == "__main__":
    main()
