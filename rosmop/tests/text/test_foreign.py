import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.text.parser import parse
from roswire.standard import standard_definitions

DEFINITIONS = standard_definitions()
EVENT = "event e(int n) /t std_msgs/Int32 '{data:n}' {"


def refused(text: str) -> tuple[int, str]:
    with pytest.raises(SpecificationError) as caught:
        MonitorSet.of(compiled_from({"x.rv": text}, DEFINITIONS))
    finding = caught.value.findings[0]
    lines = text.splitlines(keepends=True)
    return sum(map(len, lines[: finding.position.line - 1])) + finding.position.column - 1, finding.text


def test_an_open_brace_is_named() -> None:
    place, told = refused('s() {\nvoid f() { if (x) { "}"; // }\n')
    assert told.endswith("the `{` at 2:19 has no `}`"), (place, told)


def test_a_place_behind_very_many_comments_is_found() -> None:
    place, told = refused("s() { int x" + " // it's\n" * 5000 + "/* ' */ }")
    assert (place, told) == (11, "expected `;` after this, found `}` in line 5001")


@pytest.mark.parametrize(
    "behind",
    [
        "ltl: []e @violation { }",
        "LTL : []e @violation { }",
        "creation event f() every 1s { }",
        "event f() every 1s { }",
    ],
)
@pytest.mark.parametrize("between", [" ", "\n", " // what follows\n"])
def test_a_property_without_handlers_ends_where_the_next_begins(behind: str, between: str) -> None:
    [found] = parse(f"s() {{ {EVENT} }} ere: e e*{between}{behind} }}", "x.rv").specifications
    assert found.properties[0].formula.split("//")[0].strip() == "e e*"
    assert len(found.properties) + len(found.events) == 3
