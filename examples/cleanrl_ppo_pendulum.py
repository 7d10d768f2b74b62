"""PPO in one file, in the style of CleanRL, whose policy loss can be a learned one: PyTorch and Gymnasium.

python examples/cleanrl_ppo_pendulum.py --objective lpo-pendulum --seed 1

It needs the extra `torch`. The default hyperparameters are those of this project's own PPO on
Pendulum. All that an objective changes is marked "objective" below. With them, five agents earned −181 with
lpo-pendulum (−221 to −159), −190 with dpo (−279 to −160) and −238 with ppo (−323 to −186).
"""

import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

import lpo


@dataclass
class Args:
    """Train PPO with an objective of choice, then evaluate its most likely actions.

    Attributes:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, none, a name of the zoo (lpo-pendulum) or path/to/objective.npz.
      env_id: a Gymnasium environment with flat observations and continuous actions.
      seed: of networks, environments and actions.
      total_steps: environment steps, rounded up to whole batches.
      num_envs, num_steps: a batch is num_envs * num_steps transitions.
      num_epochs, num_minibatches: passes over a batch, and parts that it is cut into.
      anneal_learning_rate: linearly to zero over the training.
      gamma, gae_lambda: discount, and of generalised advantage estimation.
      max_grad_norm: of policy and value network, each by itself.
      evaluation_episodes: after the training, in environments of their own.
    """

    objective: str = "ppo"
    env_id: str = "Pendulum-v1"
    seed: int = 1
    total_steps: int = 150_000
    num_envs: int = 100
    num_steps: int = 100
    num_epochs: int = 10
    num_minibatches: int = 10
    learning_rate: float = 1e-3
    anneal_learning_rate: bool = False
    gamma: float = 0.995
    gae_lambda: float = 0.95
    entropy_coefficient: float = 0.01
    value_coefficient: float = 0.5
    max_grad_norm: float = 10.0
    evaluation_episodes: int = 20


def mlp(input_size: int, output_size: int, output_gain: float) -> nn.Sequential:
    """Two hidden layers of 64, orthogonal weights, no bias to begin with."""
    layers = [nn.Linear(input_size, 64), nn.Linear(64, 64), nn.Linear(64, output_size)]
    for layer, gain in zip(layers, (2**0.5, 2**0.5, output_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])


class Agent(nn.Module):
    """A Gaussian policy whose standard deviation does not depend on the state, and a value network."""

    def __init__(self, observation_size: int, action_size: int):
        super().__init__()
        self.mean = mlp(observation_size, action_size, 0.01)
        self.log_std = nn.Parameter(torch.zeros(action_size))
        self.critic = mlp(observation_size, 1, 1.0)

    def policy(self, observation: torch.Tensor) -> Normal:
        """[..., O] -> distribution of [..., A] actions, each component by itself."""
        return Normal(self.mean(observation), self.log_std.exp())

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """[..., O] -> [...] value."""
        return self.critic(observation).squeeze(-1)


def make_envs(env_id: str, num_envs: int) -> gym.vector.VectorEnv:
    """Copies of an environment that start a new episode within the step that ended the last."""
    # Gymnasium's default spends the next step on the reset, which would be a false transition.
    return gym.make_vec(
        env_id,
        num_envs=num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP},
    )


def tensor(array: np.ndarray) -> torch.Tensor:
    """What an environment returns, float64 or bool, in the networks' precision."""
    return torch.as_tensor(array, dtype=torch.float32)


def bounded(action: torch.Tensor, envs: gym.vector.VectorEnv) -> np.ndarray:
    """Actions as the environments take them: clipped to their space."""
    return np.clip(action.numpy(), envs.action_space.low, envs.action_space.high)


@torch.no_grad()
def evaluate(agent: Agent, args: Args, seed: int) -> float:
    """Mean return of the most likely actions, one episode in each of `evaluation_episodes` environments."""
    envs = make_envs(args.env_id, args.evaluation_episodes)
    observation, _ = envs.reset(seed=seed)
    returns = np.zeros(args.evaluation_episodes)
    running = np.ones(args.evaluation_episodes, bool)
    while running.any():
        action = agent.policy(tensor(observation)).mean
        observation, reward, terminated, truncated, _ = envs.step(bounded(action, envs))
        returns += reward * running
        running &= ~(terminated | truncated)
    envs.close()
    return float(returns.mean())


def train(args: Args) -> float:
    """Trains one agent, a line of progress an iteration; returns its evaluation."""
    # Gymnasium counts up from a seed, one an environment: neighbouring seeds would share nearly all.
    training_seed, evaluation_seed = map(int, np.random.SeedSequence(args.seed).generate_state(2))
    torch.manual_seed(args.seed)
    envs = make_envs(args.env_id, args.num_envs)
    agent = Agent(
        envs.single_observation_space.shape[0],
        envs.single_action_space.shape[0],
    )
    policy_parameters = [*agent.mean.parameters(), agent.log_std]
    value_parameters = list(agent.critic.parameters())
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    policy_loss = lpo.torch_loss(args.objective)  # objective: instead of a clip coefficient

    batch_size = args.num_envs * args.num_steps
    num_iterations = -(-args.total_steps // batch_size)
    shape = (args.num_steps, args.num_envs)
    observations = torch.zeros(*shape, *envs.single_observation_space.shape)
    next_observations = torch.zeros_like(observations)
    actions = torch.zeros(*shape, *envs.single_action_space.shape)
    log_probs, rewards = torch.zeros(shape), torch.zeros(shape)
    terminations, ends = torch.zeros(shape), torch.zeros(shape)

    observation, _ = envs.reset(seed=training_seed)
    running_return, finished = np.zeros(args.num_envs), []
    start = time.perf_counter()
    for iteration in range(num_iterations):
        progress = iteration / num_iterations
        if args.anneal_learning_rate:
            optimizer.param_groups[0]["lr"] = args.learning_rate * (1.0 - progress)

        # -- collect a batch
        for step in range(args.num_steps):
            observations[step] = tensor(observation)
            with torch.no_grad():
                policy = agent.policy(observations[step])
                actions[step] = policy.sample()
                log_probs[step] = policy.log_prob(actions[step]).sum(-1)
            observation, reward, terminated, truncated, info = envs.step(
                bounded(actions[step], envs)
            )
            end = terminated | truncated
            # What the step led to, which is not where the next episode begins.
            reached = observation.copy()
            if end.any():
                reached[end] = np.stack(info["final_obs"][end])
            next_observations[step] = tensor(reached)
            rewards[step] = tensor(reward)
            terminations[step], ends[step] = tensor(terminated), tensor(end)
            running_return += reward
            finished.extend(running_return[end])
            running_return[end] = 0.0

        # -- generalised advantage estimation: truncation stops the trace, termination the value too
        with torch.no_grad():
            values = agent.value(observations)
            next_values = agent.value(next_observations) * (1.0 - terminations)
        deltas = rewards + args.gamma * next_values - values
        advantages = torch.zeros(shape)
        following = torch.zeros(args.num_envs)
        for step in reversed(range(args.num_steps)):
            carried = args.gamma * args.gae_lambda * (1.0 - ends[step]) * following
            following = advantages[step] = deltas[step] + carried
        targets = (advantages + values).flatten()
        flat_advantages, flat_log_probs = advantages.flatten(), log_probs.flatten()
        flat_observations, flat_actions = observations.flatten(0, 1), actions.flatten(0, 1)

        # -- update
        for _ in range(args.num_epochs):
            for index in torch.randperm(batch_size).chunk(args.num_minibatches):
                policy = agent.policy(flat_observations[index])
                log_ratio = policy.log_prob(flat_actions[index]).sum(-1) - flat_log_probs[index]
                advantage = flat_advantages[index]
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)

                # objective: in CleanRL, torch.max(-A * ratio, -A * ratio.clamp(1 - eps, 1 + eps)).mean()
                surrogate_loss = policy_loss(log_ratio, advantage, progress)

                error = agent.value(flat_observations[index]) - targets[index]
                loss = (
                    surrogate_loss
                    + args.value_coefficient * 0.5 * error.square().mean()
                    - args.entropy_coefficient * policy.entropy().sum(-1).mean()
                )
                optimizer.zero_grad()
                loss.backward()
                for parameters in (policy_parameters, value_parameters):
                    nn.utils.clip_grad_norm_(parameters, args.max_grad_norm)
                optimizer.step()

        recent = f"{np.mean(finished[-args.num_envs :]):.1f}" if finished else "none yet"
        print(
            f"steps {(iteration + 1) * batch_size}  return {recent}  "
            f"seconds {time.perf_counter() - start:.1f}",
            flush=True,
        )
    envs.close()
    return evaluate(agent, args, evaluation_seed)


def main() -> None:
    """The command line."""
    args = tyro.cli(Args)
    # Networks this small are slower on more threads.
    torch.set_num_threads(1)
    result = train(args)
    print(
        f"{args.objective}, seed {args.seed}: return {result:.1f} "
        f"({args.evaluation_episodes} episodes, most likely actions)"
    )


if __name__ == "__main__":
    main()
