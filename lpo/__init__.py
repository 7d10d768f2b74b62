"""Learned policy optimisation: evolve the objective that PPO maximises, on one-step bandits, which are cheap.

Names are imported when they are first used: the command line has to configure JAX before anything
imports it for good.
"""

from importlib import import_module
from typing import Any

_HOME = {
    name: f"lpo.{module}"
    for module, names in {
        "certificate": ("Certificate", "certify"),
        "drifts": ("ClipDrift", "DPODrift", "Drift", "LearnedDrift", "NoDrift"),
        "comparison": ("Comparison", "LearningCurves", "compare", "learning_curves"),
        "inner_loop": ("MetaTrainingConfig",),
        "meta_training": ("meta_train",),
        "objectives": ("Objective", "load_objective", "save_objective"),
        "portable": (
            "drift_function",
            "loss_function",
            "numpy_drift",
            "torch_drift",
            "torch_loss",
        ),
    }.items()
    for name in names
}

__all__ = list(_HOME)
# Of `scb`, which lists them as its own.
_HOME |= dict.fromkeys(("UserError", "__version__"), "scb")


def __dir__() -> list[str]:
    return [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lpo' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
