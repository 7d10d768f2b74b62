"""Synthetic environments, and the environments that they stand for; every family of them is registered here."""

from scb.environments.brax import BraxFamily
from scb.environments.custom import CustomFamily
from scb.environments.gymnax import ClassicFamily, GymnaxFamily, MinAtarFamily
from scb.environments.registry import register
from scb.environments.zoo import SyntheticFamily

# The last takes what is left of gymnax's names.
for _family in (
    ClassicFamily,
    MinAtarFamily,
    SyntheticFamily,
    BraxFamily,
    CustomFamily,
    GymnaxFamily,
):
    register(_family())
