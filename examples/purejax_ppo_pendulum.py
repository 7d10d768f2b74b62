"""PPO in one file, in the style of PureJaxRL, whose policy loss is a learned objective: JAX, flax, optax and gymnax.

python examples/purejax_ppo_pendulum.py --objective lpo-pendulum --agents 5

All agents train at once, one seed each, in one compiled function. All that an objective changes is marked
"objective" below. With the defaults, five agents earned −173 with lpo-pendulum (−204 to −142), −222
with dpo (−267 to −167) and −240 with ppo (−298 to −196).
"""

from functools import partial
from typing import Any, NamedTuple

import distrax
import flax.linen as nn
import gymnax
import jax
import jax.numpy as jnp
import optax
import tyro
from flax.training.train_state import TrainState

import lpo

ENVS, STEPS, EPOCHS, MINIBATCHES = 100, 100, 10, 10
DISCOUNT, GAE_LAMBDA, ENTROPY, VALUE, LEARNING_RATE = 0.995, 0.95, 0.01, 0.5, 1e-3


class Network(nn.Module):
    """Two hidden layers of 64; the last layer's weights are drawn with a variance of `scale` over its inputs."""

    size: int
    scale: float

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        # No orthogonal weights: of several agents at once, their QR can hang XLA on a CPU of few cores.
        def layer(size: int, scale: float) -> nn.Dense:
            draw = nn.initializers.variance_scaling(scale, "fan_in", "truncated_normal")
            return nn.Dense(size, kernel_init=draw)

        x = nn.relu(layer(64, 2.0)(x))
        x = nn.relu(layer(64, 2.0)(x))
        return layer(self.size, self.scale)(x)


class ActorCritic(nn.Module):
    """A Gaussian whose standard deviation no observation changes, and a value; a network each."""

    actions: int

    def setup(self) -> None:
        self.actor, self.critic = Network(self.actions, 1e-4), Network(1, 1.0)
        self.log_std = self.param("log_std", nn.initializers.zeros, (self.actions,))

    def __call__(self, x: jax.Array) -> tuple[distrax.Distribution, jax.Array]:
        policy = distrax.MultivariateNormalDiag(self.actor(x), jnp.exp(self.log_std))
        return policy, self.critic(x)[..., 0]


class Step(NamedTuple):
    """What a step leaves: [ENVS, ...] each, and [STEPS, ENVS, ...] of a batch."""

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array  # of what the step led to, before a new episode begins
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


def make_train(objective: str, total_steps: int) -> Any:
    """A function of a key that trains an agent: the [] return of the trained agent's most likely actions."""
    env, params = gymnax.make("Pendulum-v1")
    space = env.action_space(params)
    network = ActorCritic(space.shape[0])
    objective_loss = lpo.loss_function(objective)  # objective
    batches = -(-total_steps // (ENVS * STEPS))
    reset = jax.vmap(env.reset, in_axes=(0, None))
    step_env = jax.vmap(env.step, in_axes=(0, 0, 0, None))

    def act(carry: Any, _: None, agent: TrainState) -> tuple[Any, Step]:
        observation, state, key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        policy, value = agent.apply_fn(agent.params, observation)
        action, log_prob = policy.sample_and_log_prob(seed=key_act)
        keys = jax.random.split(key_step, ENVS)
        inside = jnp.clip(action, space.low, space.high)
        after, state, *ended, info = step_env(keys, state, inside, params)
        _, next_value = agent.apply_fn(agent.params, info["final_observation"])
        seen = Step(observation, action, log_prob, value, next_value, *ended)
        return (after, state, key), seen

    def advantages_of(batch: Step) -> jax.Array:
        def back(following: jax.Array, step: Step) -> Any:
            # Truncation stops the trace, termination the value too.
            delta = step.reward + DISCOUNT * step.next_value * ~step.terminated - step.value
            goes_on = ~(step.terminated | step.truncated)
            advantage = delta + DISCOUNT * GAE_LAMBDA * goes_on * following
            return advantage, advantage

        return jax.lax.scan(back, jnp.zeros(ENVS), batch, reverse=True)[1]

    def loss(parameters: Any, batch: Step, advantage: Any, target: Any, progress: Any) -> Any:
        policy, value = network.apply(parameters, batch.observation)
        log_ratio = policy.log_prob(batch.action) - batch.log_prob
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        # The objective: PPO's two clipped terms and their minimum become this line.
        policy_loss = objective_loss(log_ratio, advantage, progress)
        value_loss = 0.5 * jnp.mean((value - target) ** 2)
        return policy_loss + VALUE * value_loss - ENTROPY * policy.entropy().mean()

    def iteration(carry: Any, number: jax.Array) -> tuple[Any, None]:
        agent, observation, state, key = carry
        key, key_act, key_order = jax.random.split(key, 3)
        start = (observation, state, key_act)
        (observation, state, _), batch = jax.lax.scan(partial(act, agent=agent), start, None, STEPS)
        advantage = advantages_of(batch)
        data = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]), (batch, advantage, advantage + batch.value)
        )

        def minibatch(agent: TrainState, rows: jax.Array) -> tuple[TrainState, None]:
            some = jax.tree.map(lambda x: x[rows], data)
            return agent.apply_gradients(
                grads=jax.grad(loss)(agent.params, *some, number / batches)
            ), None

        def epoch(agent: TrainState, key: jax.Array) -> tuple[TrainState, None]:
            order = jax.random.permutation(key, ENVS * STEPS).reshape(MINIBATCHES, -1)
            return jax.lax.scan(minibatch, agent, order)

        agent, _ = jax.lax.scan(epoch, agent, jax.random.split(key_order, EPOCHS))
        return (agent, observation, state, key), None

    def train(key: jax.Array) -> jax.Array:
        key, key_init, key_reset, key_judge = jax.random.split(key, 4)
        observation, state = reset(jax.random.split(key_reset, ENVS), params)
        variables = network.init(key_init, observation)
        # Values are large: with one norm for both, their gradient would leave nothing of the policy's.
        clip = optax.clip_by_global_norm(10.0)
        parts = {"params": {part: part for part in variables["params"]}}
        clipped = optax.partition({part: clip for part in variables["params"]}, parts)
        optimizer = optax.chain(clipped, optax.adam(LEARNING_RATE))
        agent = TrainState.create(apply_fn=network.apply, params=variables, tx=optimizer)
        carry = (agent, observation, state, key)
        (agent, *_), _ = jax.lax.scan(iteration, carry, jnp.arange(batches))

        def judged(carry: Any, key: jax.Array) -> Any:
            observation, state = carry
            action = agent.apply_fn(agent.params, observation)[0].mode()
            keys = jax.random.split(key, ENVS)
            after, state, reward, *_ = step_env(
                keys, state, jnp.clip(action, space.low, space.high), params
            )
            return (after, state), reward

        key_start, key_steps = jax.random.split(key_judge)
        start = reset(jax.random.split(key_start, ENVS), params)
        steps = jax.random.split(key_steps, params.max_steps_in_episode)
        return jax.lax.scan(judged, start, steps)[1].sum(0).mean()

    return train


def main(
    objective: str = "lpo-pendulum", agents: int = 5, steps: int = 150_000, seed: int = 0
) -> float:
    """Train PPO with an objective, then judge each agent by the most likely actions of 100 episodes.

    Args:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, a name of the zoo (lpo-pendulum) or path/to/objective.npz.
      agents: that train side by side.
      steps: of each agent's training, rounded up to whole batches of 10 000.
      seed: of all of them.
    """
    keys = jax.random.split(jax.random.key(seed), agents)
    returns = jax.jit(jax.vmap(make_train(objective, steps)))(keys)
    print(f"{objective} after {steps} steps: {', '.join(f'{x:.0f}' for x in sorted(returns))}")
    print(f"mean: {returns.mean():.0f}")
    return float(returns.mean())


if __name__ == "__main__":
    tyro.cli(main)
