"""Seeds: which ones search, which ones judge a search's end, and which ones are reported.

A number that was searched or chosen with is no measurement. So each purpose has seeds of its own,
and nothing that searches can be given another's.
"""

from numbers import Integral

from scb.errors import UserError

# Evolution, meta-training and every choice among settings.
SEARCHING = range(10_000)
# The zoo's tables and the reports, and nothing before them.
REPORTING = range(10_000, 30_000)
# What a search prints of its end; whoever compares searches by it has chosen with it.
VALIDATING = range(30_000, 40_000)
# Experts, recorded states and pictures that experiments show.
ILLUSTRATING = range(40_000, 60_000)


def searching(seed: int) -> int:
    """The seed itself, where it is one to search with.

    Raises:
      UserError: it is not.
    """
    given: object = seed
    if not isinstance(given, Integral):
        raise UserError(f"seed is {given!r}: it must be a whole number.")
    if seed not in SEARCHING:
        raise UserError(
            f"seed is {seed}: it must be 0 or larger, and below {SEARCHING.stop}, for those above judge what was found."
        )
    return seed


def validation(number: int = 1) -> list[int]:
    """The first seeds that judge the end of a search."""
    return _consecutive(VALIDATING, "validation", number)


def reporting(number: int = 1, offset: int = 0) -> list[int]:
    """Consecutive reporting seeds, from an offset into them on."""
    return _consecutive(REPORTING, "reporting", number, offset)


def _consecutive(purpose: range, name: str, number: int, offset: int = 0) -> list[int]:
    seeds = purpose[offset : offset + number]
    if len(seeds) != number or number < 1 or offset < 0:
        start = f" from number {offset} on" if offset else ""
        raise UserError(
            f"{number} {name} seeds{start} are asked for: there are {len(purpose)}, give at least 1 and no more than "
            "that."
        )
    return list(seeds)
