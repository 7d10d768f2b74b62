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
from lpo.drifts.mirror import MirrorDrift
from lpo.drifts.network import LearnedDrift
from scb.errors import UserError, one_of

DRIFTS: dict[str, type[Drift]] = {
    drift.name: drift
    for drift in (
        ClipDrift,
        DPODrift,
        NoDrift,
        LearnedDrift,
        ClosedFormDrift,
        MirrorDrift,
    )
}


def learned_drift(name: str, **settings: Any) -> Drift:
    """A drift that meta-training can evolve, by its family's name.

    Args:
      name: of a family in `DRIFTS` that is `learned`.
      settings: of its fields, which are its flags on the command line; the rest keep their defaults.

    Raises:
      UserError: the family is unknown, does not learn, or has no such setting.
    """
    learned = {family: drift for family, drift in DRIFTS.items() if drift.learned}
    one_of("learned drift", name, learned)
    for setting in settings:
        if setting not in learned[name].settings():
            having = [family for family, drift in learned.items() if setting in drift.settings()]
            raise UserError(
                f"the drift {name} has no {setting}, which is a setting of {', '.join(having)}: leave it out."
            )
    return learned[name](**settings)


def drift_from_config(config: Mapping[str, Any]) -> Drift:
    """The drift that `to_config` described.

    Raises:
      KeyError, TypeError: an entry is missing, or of another type.
      UserError: an unknown family, or numbers that make no drift.
    """
    name = config["family"]
    one_of("drift", name, DRIFTS)
    return DRIFTS[name].from_config(config)
