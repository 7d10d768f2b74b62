"""Times rejax's PPO in a bandit; run by `experiments.benchmark` under a python that has rejax 0.1.3 and gymnax 0.0.9.

    python rejax_peer.py BANDIT.npz POPULATION REPEATS

It imports nothing of this project, and prints seconds an agent of each repeat as JSON.
"""

# mypy: ignore-errors
import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import rejax
from flax import struct
from gymnax.environments import environment, spaces


@struct.dataclass
class State:
    context: jax.Array
    time: int


class Bandit(environment.Environment):
    """The bandit under gymnax 0.0.9's interface (a step returns five values)."""

    def __init__(self, arrays):
        super().__init__()
        self.arrays = {k: jnp.asarray(v) for k, v in arrays.items() if k != "activation"}
        self.activation = jax.nn.relu if str(arrays["activation"]) == "relu" else jnp.tanh

    def _network(self, name, inputs):
        hidden = (
            inputs @ self.arrays[f"{name}/Dense_0/kernel"] + self.arrays[f"{name}/Dense_0/bias"]
        )
        hidden = self.activation(hidden)
        return hidden @ self.arrays[f"{name}/Dense_1/kernel"] + self.arrays[f"{name}/Dense_1/bias"]

    def reset_env(self, key, params):
        latent = jax.random.normal(key, (3,))
        context = self._network("initial_state", latent)
        return context, State(context, 0)

    def step_env(self, key, state, action, params):
        action = jnp.clip(jnp.reshape(action, (1,)), -2.0, 2.0)
        reward = self._network("reward", jnp.concatenate([state.context, action]))[0]
        return state.context, State(state.context, state.time + 1), reward, jnp.bool_(True), {}

    def action_space(self, params=None):
        return spaces.Box(-2.0, 2.0, (1,))

    def observation_space(self, params=None):
        return spaces.Box(-jnp.inf, jnp.inf, (3,))


def main() -> None:
    arrays = np.load(sys.argv[1], allow_pickle=False)
    population, repeats = int(sys.argv[2]), int(sys.argv[3])
    env = Bandit(arrays)
    algorithm = rejax.PPO.create(
        env=env,
        env_params=env.default_params,
        agent_kwargs={"activation": "relu", "hidden_layer_sizes": (64, 64)},
        num_envs=5,
        num_steps=100,
        num_epochs=10,
        num_minibatches=10,
        total_timesteps=10_000,
        learning_rate=0.005,
        max_grad_norm=10.0,
        skip_initial_evaluation=True,
        eval_freq=10_000,
    )
    # Training alone is timed, here as there.
    algorithm = algorithm.replace(eval_callback=lambda *_: ())
    train = jax.jit(jax.vmap(algorithm.train))
    seconds = []
    for repeat in range(repeats + 1):
        keys = jax.random.split(jax.random.PRNGKey(repeat), population)
        start = time.perf_counter()
        jax.block_until_ready(train(keys))
        seconds.append((time.perf_counter() - start) / population)
    print(json.dumps(seconds[1:]))


if __name__ == "__main__":
    main()
