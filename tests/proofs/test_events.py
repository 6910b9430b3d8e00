"""Faults in the code generator for events are found: each instruction of four events is mutated in every way.

A mutation changes an operand, constant, operation, comparison, sign, width or offset, or omits or inverts a check.
"""

from collections import Counter

import pytest

from rosmop.tests.prove.module_mutants import FAULTS, FAULTY, faulty

_PUBLISHES = "uses a message to publish"
UNDECIDED = {
    "output, and what the module leaves": {
        ("comparison", _PUBLISHES): 1,
        ("constant", _PUBLISHES): 4,
        ("check", _PUBLISHES): 2,
        ("operand", "uses a variable for an address and a number"): 2,
    },
    "names that are kept, and seconds": {
        ("offset", "uses a constant string or array, or one that is kept"): 4
    },
}
"""The number of mutants that are rejected without z3, by the kind of the fault and the answer."""


@pytest.mark.timeout(1200)  # beside other work, the slowest takes more than the usual five minutes
@pytest.mark.parametrize("text", FAULTY)
def test_every_fault_is_found_or_none(text: str) -> None:
    """z3 decides all mutants except those in `UNDECIDED`: each differs for some message, or is proved equivalent.

    Mutants that leave more messages to Python count as equivalent, and so do mutants of unreachable or redundant
    code.
    """
    told = Counter(faulty(FAULTY[text]))
    assert {kind for kind, _ in told} == {*FAULTS, "operand"}
    decided = {"equal", "not equal"}
    assert {answer for _, answer in told} >= decided
    undecided = {(kind, answer): count for (kind, answer), count in told.items() if answer not in decided}
    assert undecided == UNDECIDED.get(text, {})
    found = sum(count for (_, answer), count in told.items() if answer == "not equal")
    assert found > 90
