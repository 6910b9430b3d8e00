import pytest

from rosmop.logics import past_monitors
from rosmop.tests.examples import examples
from rosmop.tests.verdicts import differing

PROPERTIES = {
    "fsm": 150, "tfsm": 600, "ere": 1200, "cfg": 250, "ltl": 40, "ptltl": 120, "mtl": 1500, "mtl about the future": 300,
    "pattern": 240, "ptcaret": 400, "srs": 600,
}  # fmt: skip
SHORT = {"fsm": 120, "ere": 120, "cfg": 39, "ltl": 39, "pattern": 5}


@pytest.mark.parametrize("logic", PROPERTIES)
def test_verdicts_of_random_properties_are_those_of_the_definition(logic: str) -> None:
    judged = [*differing(logic, examples(6 * PROPERTIES[logic]), seed=11, each=2, short=SHORT.get(logic, 20))]
    assert [difference for _, difference in judged if difference] == []


def test_formulas_too_large_to_simplify_at_each_event_have_the_same_verdicts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(past_monitors, "MAX_FOLDED", 0)
    for logic in ("mtl", "ptltl"):
        judged = differing(logic, 2 * PROPERTIES[logic], seed=12, each=2, short=5)
        assert [difference for _, difference in judged if difference] == []
