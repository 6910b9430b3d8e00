"""Faults in the code generator for events are found: each instruction of four events is mutated in every way.

A mutation changes an operand, constant, operation, comparison, sign, width or offset, or omits or inverts a check.
"""

from collections import Counter

import pytest

from rosmop.prove.equality import EQUAL, LEFT
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
        ("offset", "uses a constant string or array, or one that is kept"): 1
    },
}
"""The number of mutants that neither z3 nor a run decides, by the kind of the fault and the answer. None passes as
equal.
"""


@pytest.mark.timeout(1200)  # beside other work, the slowest takes more than the usual five minutes
@pytest.mark.parametrize("text", FAULTY)
def test_every_fault_is_found_or_none(text: str) -> None:
    """All except those of `UNDECIDED` are decided: a mutant differs for some message, or is proved equivalent.

    Mutants that leave more messages to Python count as equivalent, and so do mutants of unreachable or redundant
    code; a mutant that leaves all messages is rejected.
    """
    told = Counter(faulty(FAULTY[text]))
    assert {kind for kind, _ in told} == {*FAULTS, "operand"}
    decided = {EQUAL, "not equal", LEFT}
    assert {answer for _, answer in told} >= decided - {LEFT}
    undecided = {(kind, answer): count for (kind, answer), count in told.items() if answer not in decided}
    assert undecided == UNDECIDED.get(text, {})
    found = sum(count for (_, answer), count in told.items() if answer == "not equal")
    assert found > 90
