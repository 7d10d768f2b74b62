"""Objectives outside this library: the drift as a plain function in JAX, NumPy or PyTorch.

A PPO that is not this project's maximises `mean(ratio * advantage - drift)` in place of the mean of
its clipped minimum (Lu et al., 2022). What a drift was learned on comes with it: log-ratios clipped
at ±`MAX_LOG_RATIO`, and advantages that the caller has normalised over the minibatch.

    policy_loss = lpo.loss_function("lpo-pendulum")  # in PyTorch lpo.torch_loss
    loss = policy_loss(new_log_prob - old_log_prob, advantage, progress)
"""

import importlib
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lpo.drifts import Drift
from lpo.objectives import Named, Objective, load_objective
from scb.agents.drift import MAX_LOG_RATIO
from scb.errors import UserError, needed_for

if TYPE_CHECKING:
    import torch

    TorchFunction: TypeAlias = Callable[..., torch.Tensor]


def drift_function(
    objective: Named,
) -> Callable[..., jax.Array]:
    """The drift of an objective, its parameters filled in, for JAX: pure, to be jitted and differentiated.

    Args:
      objective: as from `load_objective`, or what that takes.

    Returns:
      (log_ratio, advantage, progress) -> penalty:
        log_ratio: [...] log pi(a|s) - log pi_behaviour(a|s), in nats; clipped at ±MAX_LOG_RATIO. A loss has to clip it
          for its ratio too, as `loss_function` does: further out the penalty stays, and the ratio grows.
        advantage: [...] normalised over the minibatch.
        progress: a number or [...], the fraction of training done, in [0, 1]. Only temporal drifts
          depend on it, and others need none.
        penalty: [...], in units of the advantage.
      It raises a UserError where log_ratio and advantage differ in shape, where progress is neither one number nor
      one for each, and where a temporal drift is given none. So it does for progress outside of [0, 1], but of tensors
      and of JAX's arrays, whose values are not looked at.

    Raises:
      UserError: as `load_objective`.
    """
    objective = load_objective(objective)
    return partial(_in_jax, objective.drift, objective.parameters)


def loss_function(objective: Named) -> Callable[..., jax.Array]:
    """What takes the place of PPO's policy loss in JAX: the mean of drift - ratio * advantage, to be minimised.

    Arguments and errors as for `drift_function`, and a UserError for an empty batch; what is returned gives a scalar.
    Ratio and penalty are both of the clipped log-ratio, as in training: beyond ±MAX_LOG_RATIO the gradient is zero.
    """
    objective = load_objective(objective)
    return partial(_loss_in_jax, objective.drift, objective.parameters)


def numpy_drift(
    objective: Named,
) -> Callable[..., np.ndarray]:
    """The drift of an objective for NumPy; arguments and errors as for `drift_function`.

    It computes in float32 or float64, as what it is given is, and in float64 for lists and integers.

    Raises:
      UserError: as `load_objective`.
    """
    objective = load_objective(objective)
    return partial(_in_numpy, objective.drift, _host_parameters(objective))


def torch_drift(objective: Named) -> "TorchFunction":
    """The drift of an objective for PyTorch, differentiable; arguments and errors as for `drift_function`.

    It takes tensors and computes on log_ratio's device, in its type or, of half precision and under autocast, which
    hold no squares of large ratios, in float32.

    Raises:
      UserError: as for `numpy_drift`, or PyTorch is not installed.
    """
    return _for_torch(_in_torch, objective)


def torch_loss(objective: Named) -> "TorchFunction":
    """`loss_function` for PyTorch; arguments and errors as for `torch_drift`, and a UserError for an empty batch."""
    return _for_torch(_loss_in_torch, objective)


def _policy_loss(xp: Any, penalty: Any, log_ratio: Any, advantage: Any) -> Any:
    if 0 in penalty.shape:
        raise UserError(
            f"log_ratio and advantage have shape {tuple(penalty.shape)}, which is of no actions: a loss is the mean "
            "over a minibatch of one or more."
        )
    ratio = xp.exp(xp.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO))
    return (penalty - ratio * advantage).mean()


def _for_torch(function: "TorchFunction", objective: Named) -> "TorchFunction":
    with needed_for("a drift for PyTorch needs", "torch", "torch"):
        importlib.import_module("torch")
    objective = load_objective(objective)
    return partial(function, objective.drift, _host_parameters(objective))


# What users hold are partials of these functions of a module, which can be pickled.


def _in_jax(drift: Drift, parameters: Any, *arguments: Any, **named: Any) -> Any:
    return _converted(jnp, drift, parameters, *arguments, **named)


def _loss_in_jax(
    drift: Drift, parameters: Any, log_ratio: Any, advantage: Any, progress: Any = None
) -> Any:
    penalty = _in_jax(drift, parameters, log_ratio, advantage, progress)
    return _policy_loss(
        jnp, penalty, *(jnp.asarray(x, penalty.dtype) for x in (log_ratio, advantage))
    )


def _in_numpy(drift: Drift, parameters: Any, *arguments: Any, **named: Any) -> Any:
    return _converted(np, drift, parameters, *arguments, **named)


def _in_torch(
    drift: Drift, parameters: Any, log_ratio: Any, advantage: Any, progress: Any = None
) -> Any:
    import torch

    for name, value in (("log_ratio", log_ratio), ("advantage", advantage)):
        if not isinstance(value, torch.Tensor):
            raise UserError(
                f"{name} is no tensor of PyTorch but of the class {type(value).__name__}: give a tensor, such as "
                "torch.as_tensor makes, or use lpo.numpy_drift, or lpo.loss_function in JAX."
            )
    if not log_ratio.is_floating_point():  # which would cut the advantage's decimals off
        log_ratio = log_ratio.to(advantage if advantage.is_floating_point() else torch.float32)
    log_ratio = log_ratio.to(torch.promote_types(log_ratio.dtype, torch.float32))
    device = log_ratio.device.type
    off = (
        torch.autocast(device, enabled=False)
        if torch.amp.is_autocast_available(device)
        else nullcontext()
    )
    with off:
        return _evaluate(torch, drift, parameters, log_ratio, advantage.to(log_ratio), progress)


def _loss_in_torch(
    drift: Drift, parameters: Any, log_ratio: Any, advantage: Any, progress: Any = None
) -> Any:
    penalty = _in_torch(drift, parameters, log_ratio, advantage, progress)
    import torch

    return _policy_loss(torch, penalty, log_ratio.to(penalty), advantage.to(penalty))


def _converted(
    xp: Any,
    drift: Drift,
    parameters: Any,
    log_ratio: ArrayLike,
    advantage: ArrayLike,
    progress: ArrayLike | None = None,
) -> Any:
    """`_evaluate` of whatever is like an array, in the floating-point type that it has together."""
    for name, value in (("log_ratio", log_ratio), ("advantage", advantage)):
        kind = getattr(getattr(value, "dtype", None), "kind", "f")
        if isinstance(value, str) or kind in "USO":
            raise UserError(f"{name} is {value!r}, which is no array of numbers: give one.")
    dtype = xp.result_type(xp.asarray(log_ratio), xp.asarray(advantage), xp.float32)
    log_ratio, advantage = xp.asarray(log_ratio, dtype), xp.asarray(advantage, dtype)
    return xp.asarray(_evaluate(xp, drift, parameters, log_ratio, advantage, progress))


def _evaluate(
    xp: Any,
    drift: Drift,
    parameters: Any,
    log_ratio: Any,
    advantage: Any,
    progress: Any,
) -> Any:
    # [B, 1] against [B] would broadcast to [B, B] and train something else.
    if log_ratio.shape != advantage.shape:
        raise UserError(
            f"log_ratio has shape {tuple(log_ratio.shape)} and advantage {tuple(advantage.shape)}: "
            "a drift takes two of the same shape."
        )
    if progress is None:
        if drift.temporal:
            raise UserError(
                "this drift depends on the fraction of training done: give progress, a number in [0, 1]."
            )
        progress = 0.0
    if isinstance(progress, jax.Array) and xp is not jnp:
        progress = np.array(progress)  # a tensor cannot be made of JAX's
    # A tensor's or a traced array's values are not looked at: that would wait for a device.
    inside = True
    # A number apart, for torch.compile cannot follow a branch on an array.
    if isinstance(progress, int | float):
        inside = 0 <= progress <= 1
    elif isinstance(progress, str | bytes | complex | list | tuple | np.generic | np.ndarray):
        fractions = np.asarray(progress)
        inside = fractions.dtype.kind in "biuf" and bool(
            np.all((fractions >= 0) & (fractions <= 1))
        )
    if not inside:
        raise UserError(f"progress is {progress}: it is the fraction of training done, in [0, 1].")
    if np.shape(progress) not in ((), log_ratio.shape):
        raise UserError(
            f"progress has shape {np.shape(progress)} and log_ratio {tuple(log_ratio.shape)}: "
            "give one number, or one for each."
        )
    # JAX brings numbers to where the arrays are, which may be several devices, or none yet.
    device = None if xp is jnp else log_ratio.device
    like = partial(xp.asarray, dtype=log_ratio.dtype, device=device)
    log_ratio = xp.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO)
    progress = xp.broadcast_to(like(progress), log_ratio.shape)
    return drift(_mapped(like, parameters), log_ratio, advantage, progress, xp)


def _mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """As `jax.tree.map`, which torch.compile cannot follow."""
    if isinstance(tree, Mapping):
        return {name: _mapped(function, x) for name, x in tree.items()}
    if isinstance(tree, list | tuple):
        made = [_mapped(function, x) for x in tree]
        return type(tree)(*made) if hasattr(tree, "_fields") else type(tree)(made)
    return function(tree)


def _host_parameters(objective: Objective) -> Any:
    # Copied: what comes off a device is read-only, which torch warns of.
    return jax.tree.map(np.array, jax.device_get(objective.parameters))
