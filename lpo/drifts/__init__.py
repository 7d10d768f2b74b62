"""Drift functionals: what a policy update pays for moving away from the behaviour policy.

A drift f(ratio, advantage) >= 0 with value and gradient zero at ratio = 1 keeps PPO-style updates
inside the mirror-learning framework (Kuba et al., 2022), whose members all improve monotonically.
PPO maximises `mean(ratio * advantage - f)`. PPO's clip, DPO's closed form and what was learned are
members of one contract, so that a training loop cannot tell them apart.

A new family is a module with a subclass of `Drift`, and its line in `DRIFTS`. Files, `lpo meta-train
--drift NAME`, certificates and the forms in NumPy and PyTorch follow from that.
"""

from collections.abc import Mapping
from typing import Any

from lpo.drifts.contract import Drift
from lpo.drifts.formula import ClosedFormDrift
from lpo.drifts.known import ClipDrift, DPODrift, NoDrift
from lpo.drifts.network import LearnedDrift
from scb.errors import unknown_name

DRIFTS: dict[str, type[Drift]] = {
    drift.name: drift
    for drift in (
        ClipDrift,
        DPODrift,
        NoDrift,
        LearnedDrift,
        ClosedFormDrift,
    )
}


def drift_from_config(config: Mapping[str, Any]) -> Drift:
    """The drift that `to_config` described.

    Raises:
      KeyError, TypeError: an entry is missing, or of another type.
      UserError: an unknown family, or numbers that make no drift.
    """
    if "family" in config:
        name = config["family"]
    else:  # from before there were families, when a file held a network or a formula
        name = (ClosedFormDrift if "expression" in config else LearnedDrift).name
    if name not in DRIFTS:
        raise unknown_name("drift", str(name), DRIFTS)
    return DRIFTS[name].from_config(config)
