"""Brax's continuous-control environments (Freeman et al., 2021) behind gymnax 1.x's interface.

Three things differ from `brax.envs.training.wrap`: termination and truncation are told apart, an
episode that ends is followed by one from a randomly drawn start state rather than always the first,
and the time limit is a parameter. Returns of different physics backends are not comparable: a
result says which one it used.
"""

import contextlib
import inspect
import io
import logging
import types
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces

from scb.environments.brax_physics import accelerate
from scb.environments.returns import IDLE, table
from scb.environments.spec import Family, Made, Reference
from scb.errors import UserError, one_of
from scb.keys import root_key, split_key

if TYPE_CHECKING:
    import brax.envs

# Written out, because asking brax for its list imports it, which costs a second; a test holds the
# two equal. Brax's twelfth name, "fast", is a stub without physics for its own tests.
BRAX_NAMES = (
    "ant",
    "halfcheetah",
    "hopper",
    "humanoid",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "pusher",
    "reacher",
    "swimmer",
    "walker2d",
)
BACKENDS = ("generalized", "positional", "spring", "mjx")
DEFAULT_BACKEND = "generalized"

# Final returns of agents trained in the environment, Liesen et al. (2024), table of Brax results, columns EE,
# which is with the generalized physics.
_EXPERTS: dict[str, dict[str, float]] = {
    "hopper": {"ppo": 2521.9, "sac": 3119.4, "ddpg": 1536.0, "td3": 3325.8},
    "walker2d": {"ppo": 2039.6, "sac": 4140.1, "ddpg": 698.3, "td3": 4605.8},
    "swimmer": {"ppo": 83.6, "sac": 124.8, "ddpg": 348.5, "td3": 232.2},
    "halfcheetah": {"ppo": 3487.1, "sac": 7735.5, "ddpg": 3263.3, "td3": 13213.5},
    "humanoidstandup": {"ppo": 17243.5, "sac": 23808.1, "ddpg": 24944.8, "td3": 28376.2},
}
# 1000 steps that each pay brax's healthy reward, whatever the physics. Zero actions come near it for hopper
# and ant; a limp walker2d or humanoid falls. Where there is none, zero actions were measured.
_HEALTHY = {"ant": 1000.0, "hopper": 1000.0, "humanoid": 5000.0, "walker2d": 1000.0}

logger = logging.getLogger(__name__)


@struct.dataclass
class BraxState(environment.EnvState):
    """`time` counts this episode's steps; `brax_state` is what brax's step takes and returns."""

    brax_state: "brax.envs.State"


@struct.dataclass
class BraxParams(environment.EnvParams):
    """The time limit, after which an episode is truncated; the physics are fixed."""

    max_steps_in_episode: int = 1000


class BraxEnvironment(environment.Environment[BraxState, BraxParams]):
    """A brax environment as a gymnax 1.x environment, hashable by what it was made from.

    `reset` runs brax's reset, so its start state is new for every key. Auto-reset would have to
    compute a whole reset at every step, and under `vmap` no branch avoids it; it draws from a pool
    of start states computed once instead. Measured with 64 hoppers under random actions on two CPU
    cores, as a share of the speed of brax's bare step: 0.95 with the pool and 0.79 with a reset in
    every step on the spring backend, 1.00 and 0.95 on the generalized one. The size of the pool did
    not matter between 64 and 4096 states.

    Args:
      name: one of `BRAX_NAMES`.
      backend: one of `BACKENDS`; swimmer knows only "generalized".
      num_start_states: size of the pool that auto-reset draws from, the same in every process, and that episodes
        of an evaluation start in (`scb.evaluation.evaluate`), whatever its seed; None resets the physics afresh at
        the end of every episode.

    Raises:
      UserError: an unknown name or backend, or a pool without states.
    """

    def __init__(
        self, name: str, backend: str = DEFAULT_BACKEND, num_start_states: int | None = 1024
    ) -> None:
        super().__init__()
        one_of("Brax environment", name, BRAX_NAMES)
        one_of("Brax backend", backend, BACKENDS)
        if num_start_states is not None and num_start_states < 1:
            raise UserError(
                f"num_start_states is {num_start_states}: give 1 or more, or None to reset the "
                "physics afresh each time."
            )
        self._name = name
        self.backend = backend
        self._num_start_states = num_start_states
        self.brax_env = _load(name, backend)
        start = jax.eval_shape(self.brax_env.reset, root_key(0))
        self._observation_shape: tuple[int, ...] = start.obs.shape

    # jit keys its cache on `self`: two environments made alike share one compiled program.
    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._made_from == other._made_from

    def __hash__(self) -> int:
        return hash(self._made_from)

    def __reduce__(self) -> Any:
        # The physics, which hold functions, are loaded where it is unpickled.
        return type(self), self._made_from

    def __repr__(self) -> str:
        return f"BraxEnvironment({self._name!r}, backend={self.backend!r})"

    @property
    def _made_from(self) -> tuple[str, str, int | None]:
        return self._name, self.backend, self._num_start_states

    @property
    def name(self) -> str:
        """Brax's name, such as "hopper"."""
        return self._name

    @property
    def default_params(self) -> BraxParams:
        """Brax's own time limit of 1000 steps."""
        return BraxParams()

    @property
    def num_actions(self) -> int:
        """Number of actuators."""
        return int(self.brax_env.action_size)

    def action_space(self, params: BraxParams | None = None) -> spaces.Box:
        """[-1, 1] per actuator; brax scales it to the actuator's own range."""
        return spaces.Box(-1.0, 1.0, (self.num_actions,), jnp.float32)

    def observation_space(self, params: BraxParams | None = None) -> spaces.Box:
        """Unbounded: brax states no bounds."""
        return spaces.Box(-jnp.inf, jnp.inf, self._observation_shape, jnp.float32)

    @partial(jax.jit, static_argnames=("self",))
    def reset(
        self, key: jax.Array, params: BraxParams | None = None
    ) -> tuple[jax.Array, BraxState]:
        """Brax's reset with this key.

        Returns:
          [O] observation, state at time 0.
        """
        return self._start(self.brax_env.reset(key))

    def reset_env(self, key: jax.Array, params: BraxParams) -> tuple[jax.Array, BraxState]:
        """What auto-reset calls at every step, and an evaluation once: a start state from the pool.

        Brax's own wrapper returns to the cached state that its environment first started in, so
        that N environments see N start states in all of training. Here every episode draws anew
        from all of the pool.
        """
        if self._num_start_states is None:
            return self._start(self.brax_env.reset(key))
        pool = _start_states(self._name, self.backend, self._num_start_states)
        index = jax.random.randint(key, (), 0, self._num_start_states)
        return self._start(jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], pool))

    def step_env(
        self,
        key: jax.Array,
        state: BraxState,
        action: int | float | jax.Array,
        params: BraxParams,
    ) -> tuple[jax.Array, BraxState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One brax step, without auto-reset.

        Args:
          key: unused, brax's dynamics are deterministic.
          state: where to step from.
          action: [A] clipped to [-1, 1], for the physics and for the reward's control cost alike.
          params: the time limit.

        Returns:
          [O] observation, next state, reward, terminated, {"discount"}.
        """
        chex.assert_shape(action, (self.num_actions,))
        # Brax writes its metrics into the dictionaries that it is given: hand it copies.
        before = jax.tree.map(lambda leaf: leaf, state.brax_state)
        after = self.brax_env.step(before, jnp.clip(action, -1.0, 1.0))
        # Some environments return Python numbers (reward = 1.0); auto-reset's select and scan want
        # the dtypes of reset.
        after = jax.tree.map(lambda old, new: jnp.asarray(new, old.dtype), state.brax_state, after)
        next_state = BraxState(time=state.time + 1, brax_state=after)
        observation, next_state = self._apply_transition_gradient_policy(after.obs, next_state)
        terminated = self.is_terminated(next_state, params)
        info = {"discount": self.discount(next_state, params)}
        return observation, next_state, after.reward, terminated, info

    def is_terminated(self, state: BraxState, params: BraxParams) -> jax.Array:
        """Whether brax ended the episode; its `done` knows no time limit."""
        return state.brax_state.done > 0.5

    def is_truncated(self, state: BraxState, params: BraxParams) -> jax.Array:
        """Whether the time limit alone ended the episode: a fall at the last step terminates."""
        at_limit = state.time >= params.max_steps_in_episode
        return jnp.logical_and(at_limit, jnp.logical_not(self.is_terminated(state, params)))

    def forward_velocity(self, state: BraxState) -> jax.Array:
        """[] metres a second along x, as brax measures it over the last step; NaN where brax measures none."""
        return jnp.asarray(state.brax_state.metrics.get("x_velocity", jnp.nan), jnp.float32)

    @staticmethod
    def _start(brax_state: "brax.envs.State") -> tuple[jax.Array, BraxState]:
        return brax_state.obs, BraxState(time=jnp.zeros((), jnp.int32), brax_state=brax_state)


class BraxFamily(Family):
    """Brax's environments, with the paper's experts."""

    name = "brax"
    suite = (
        "hopper",
        "walker2d",
        "halfcheetah",
        "reacher",
        "inverted_pendulum",
        "inverted_double_pendulum",
    )

    def names(self) -> Sequence[str]:
        return BRAX_NAMES

    def make(self, name: str, **arguments: Any) -> Made:
        env = BraxEnvironment(name, **arguments)
        return env, env.default_params

    def facts(self, name: str) -> Mapping[str, Any]:
        experts = {
            algorithm: Reference(value, f"{algorithm.upper()}, Liesen et al. (2024)")
            for algorithm, value in _EXPERTS.get(name, {}).items()
        }
        standing = {**table(IDLE).get(name, {})}
        if name in _HEALTHY:
            standing = dict.fromkeys(BACKENDS, _HEALTHY[name])
        return {
            "backends": BACKENDS,
            "default_backend": DEFAULT_BACKEND,
            "experts": {DEFAULT_BACKEND: experts},
            "standing": standing,
        }


@cache
def _load(name: str, backend: str) -> "brax.envs.Env":
    # The loaded system outlives whatever is being traced: none of its arrays may be a tracer.
    with jax.ensure_compile_time_eval(), _quiet():
        import brax.envs
        import brax.fluid

        _accept_old_clip_keywords(brax.fluid)
        try:
            loaded = brax.envs.get_environment(name, backend=backend)
        except ValueError as error:
            raise UserError(
                f"Brax's {name} has no {backend!r} backend: use backend='generalized'."
            ) from error
        if backend == "generalized":
            accelerate(loaded)
        return loaded


@cache
def _start_states(name: str, backend: str, number: int) -> "brax.envs.State":
    """Reset states with a leading axis [number]; NumPy arrays, as they go into any program."""
    with jax.ensure_compile_time_eval():
        keys = split_key(root_key(0), number)
        # A loop, not vmap: it compiles twice as fast, and even so compiling is all that this costs.
        reset_all = jax.jit(partial(jax.lax.map, _load(name, backend).reset))
        return jax.tree.map(np.asarray, reset_all(keys))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps brax's prints off standard output, and MuJoCo's log file out of the working directory.

    Importing brax prints that an optional GPU engine is absent. Loading a model warns that brax is
    in maintenance and, through MuJoCo, which attributes of brax's own models are deprecated. No
    user can act on any of it, so it goes to the debug log.
    """
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Brax System", category=UserWarning)
        import mujoco  # type: ignore[import-untyped]

        previous = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: logger.debug("MuJoCo: %s", message))
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(previous)
    if printed.getvalue():
        logger.debug("Brax: %s", printed.getvalue().strip())


def _accept_old_clip_keywords(fluid: Any) -> None:
    """Lets brax 0.14.2's fluid model call jnp.clip(x, a_min=...), as JAX once allowed.

    Without this, swimmer, alone in having a fluid, cannot take one step under JAX 0.10. Nothing
    changes but the name `jp` inside the module `brax.fluid`.
    """
    if fluid.jp is jnp and "a_min" not in inspect.signature(jnp.clip).parameters:
        clip = {"clip": lambda x, a_min=None, a_max=None: jnp.clip(x, a_min, a_max)}
        fluid.jp = types.SimpleNamespace(**(vars(jnp) | clip))
