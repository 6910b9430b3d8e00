import pytest

from rosmop.tests.verdicts import LOGICS, differing

DEAR = {"parametric": 100, "pattern": 250, "mtl about the future": 500}


@pytest.mark.parametrize("logic", LOGICS)
def test_verdicts_match_the_definitions(logic: str) -> None:
    judged = [*differing(logic, DEAR.get(logic, 2000), seed=1)]
    assert [difference for _, difference in judged if difference] == []
    assert sum(count for count, _ in judged) >= 100
