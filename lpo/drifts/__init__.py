"""Drift functionals: what a policy update pays for moving away from the behaviour policy.

A drift f(ratio, advantage) >= 0 with value and gradient zero at ratio = 1 keeps PPO-style updates
inside the mirror-learning framework (Kuba et al., 2022), whose members all improve monotonically.
PPO maximises `mean(ratio * advantage - f)`. PPO's clip, DPO's closed form and what was learned are
members of one contract, so that a training loop cannot tell them apart.

A new family is a subclass of `Drift`, with its line in `DRIFTS` or in somebody's own module, whose family is named
`package.module:Class`. Files, `lpo meta-train --drift NAME`, certificates and the forms in NumPy and PyTorch follow
from that.
"""

from collections.abc import Mapping
from typing import Any

from lpo.drifts.contract import Drift, check_static, with_defaults
from lpo.drifts.formula import ClosedFormDrift
from lpo.drifts.known import ClipDrift, DPODrift, NoDrift
from lpo.drifts.mirror import MirrorDrift
from lpo.drifts.network import LearnedDrift
from scb import own
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


def own_family(name: str) -> type[Drift]:
    """Somebody's own family by `package.module:Class`.

    Raises:
      UserError: it cannot be imported, or is none.
    """
    found = own.imported(name, "drift", "Class")
    if not (isinstance(found, type) and issubclass(found, Drift)):
        kind = found.__name__ if isinstance(found, type) else type(found).__name__
        raise UserError(f"the drift {name} is a {kind}: it must be a subclass of lpo.Drift.")
    return found


def learned_drift(name: str, **settings: Any) -> Drift:
    """A drift that meta-training can evolve, by its family's name.

    Args:
      name: of a family in `DRIFTS` that is `learned`, or of one's own (`own_family`).
      settings: of its fields, which are its flags on the command line; the rest keep their defaults.

    Raises:
      UserError: the family is unknown, does not learn, has no such setting, or one without a default, or tells no
        programs apart.
    """
    learned = {family: drift for family, drift in DRIFTS.items() if drift.learned}
    if own.is_own(name):
        learned[name] = own_family(name)
        if not learned[name].learned:
            raise UserError(
                f"the drift {name} does not learn: give its class learned = True, and parameters to init."
            )
    one_of("learned drift", name, learned)
    advice = "give each of its fields a default, which a flag may change"
    check_static(with_defaults(learned[name], name, advice))
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
    if own.is_own(name):
        return own_family(name).from_config(config)
    one_of("drift", name, DRIFTS)
    return DRIFTS[name].from_config(config)
