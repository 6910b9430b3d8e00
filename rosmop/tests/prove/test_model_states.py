import pytest

from rosmop.tests.prove.preset_faults import answers, difference

RARE = """s() { std::string last; int n = 0;
    event e(int x) /plain own/Plain '{count:x}' { if (last == caller(e) && x * 77 == 1234541) { n = 1; } } }"""


@pytest.mark.nightly
def test_a_run_shows_a_difference_that_only_z3_finds() -> None:
    """Only 16033 times 77 is this number, also modulo 2**32."""
    wrong = RARE.replace("n = 1", "n = 2")
    assert difference(RARE, wrong) is None
    [answer] = answers(RARE, wrong, patience=100)
    assert answer.startswith("not equal: the variable")
    assert (16033).to_bytes(4, "little").hex() in answer
