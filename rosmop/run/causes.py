"""What is told of what made a verdict: events, when they were, and whose messages; `why.py` finds them."""

from typing import NamedTuple


class Sender(NamedTuple):
    """Who sent a message (0: nobody; numbered by who has the monitors), and its number, if it has one by its `kind`."""

    source: int = 0
    number: int = 0
    kind: int = 0


NOBODY = Sender()
NO_NUMBER, SEQ = range(2)
"""Kinds of numbers: none; `seq` of the header."""


class Happened(NamedTuple):
    """An event (its number in the specification), when, whose message it was; the state after it, if it has a name."""

    event: int
    time: int
    sender: Sender
    state: str = ""


class Explanation(NamedTuple):
    """Events that alone give a verdict. None of them can be left out if they are the `fewest`.

    `since`: they give it to the property as it was at this time (ns), after events that are not kept any more.
    """

    events: tuple[Happened, ...]
    fewest: bool = True
    since: int | None = None
