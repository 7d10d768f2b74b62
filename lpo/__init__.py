"""Learned policy optimisation: evolve the objective that PPO maximises, on bandits a hundred times cheaper.

Names are imported when they are first used: the command line has to configure JAX before anything
imports it for good.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lpo.certificate import Certificate, certify
    from lpo.drift import ClipDrift, DPODrift, Drift, LearnedDrift, NoDrift
    from lpo.generalization import compare, learning_curves
    from lpo.meta_training import MetaTrainingConfig, meta_train
    from lpo.objectives import Objective, load_objective, save_objective
    from lpo.portable import drift_function, numpy_drift, torch_drift, torch_loss

_HOME = {
    "Certificate": "lpo.certificate",
    "certify": "lpo.certificate",
    "ClipDrift": "lpo.drift",
    "DPODrift": "lpo.drift",
    "Drift": "lpo.drift",
    "LearnedDrift": "lpo.drift",
    "NoDrift": "lpo.drift",
    "compare": "lpo.generalization",
    "learning_curves": "lpo.generalization",
    "MetaTrainingConfig": "lpo.meta_training",
    "meta_train": "lpo.meta_training",
    "Objective": "lpo.objectives",
    "load_objective": "lpo.objectives",
    "save_objective": "lpo.objectives",
    "drift_function": "lpo.portable",
    "numpy_drift": "lpo.portable",
    "torch_drift": "lpo.portable",
    "torch_loss": "lpo.portable",
}

__all__ = [
    "Certificate",
    "ClipDrift",
    "DPODrift",
    "Drift",
    "LearnedDrift",
    "MetaTrainingConfig",
    "NoDrift",
    "Objective",
    "certify",
    "compare",
    "drift_function",
    "learning_curves",
    "load_objective",
    "meta_train",
    "numpy_drift",
    "save_objective",
    "torch_drift",
    "torch_loss",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lpo' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
