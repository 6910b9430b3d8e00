"""Faults in what writes the modules of events are found: each instruction of three events, wrong in every way.

A wrong operand, constant, operation, comparison, sign, width, offset; a check that is left out or turned round.
"""

from collections import Counter

import pytest

from rosmop.tests.prove.module_mutants import FAULTS, FAULTY, faulty


@pytest.mark.parametrize("text", FAULTY)
def test_every_fault_is_found_or_none(text: str) -> None:
    """z3 decides all: a mutant differs for some message, or is proved to be as good.

    As good are those that leave more messages to Python (a bound that is too narrow costs time, no verdict), and those
    in what is never reached or does not count: a check that another one repeats, the sign of what is never negative.
    """
    told = Counter(faulty(FAULTY[text]))
    kinds, answers = {kind for kind, _ in told}, {answer for _, answer in told}
    assert kinds == {*FAULTS, "operand"}
    unproved = {"uses a variable for an address and a number", "uses Publish"}
    assert answers - unproved == {"equal", "not equal"}
    found = sum(count for (_, answer), count in told.items() if answer == "not equal")
    assert found > 90
