from typing import Annotated, Any

import jsonschema_rs
import msgspec
import pytest

from appliance.api.front.moments import describe, in_full, parse_moment
from appliance.api.front.problems import ProblemError
from appliance.api.front.routing import CONTRACT
from appliance.channel.answers.field_docs import UNIT, Moment, NanoMoment, doc
from appliance.channel.answers.graph_answers import Graph
from tests.support.answers import example


class _Inner(msgspec.Struct):
    at: Annotated[Moment | None, doc("null: never")]
    exact: NanoMoment


class _Outer(msgspec.Struct):
    since: Moment
    rows: list[_Inner]
    named: dict[str, _Inner | None]
    pair: tuple[int, _Inner]
    text: str = "since"


_INNER = {"at": None, "exact": 1_795_155_646_123_456_789, "exact_utc": "2026-11-20T06:20:46.123456789Z"}


def _outer() -> _Outer:
    inner = _Inner(None, 1_795_155_646_123_456_789)
    return _Outer(1_795_155_646.1, [inner], {"a": inner, "b": None}, (3, inner))


def test_each_time_has_its_text_beside_it() -> None:
    assert in_full(_outer()) == {
        "since": 1_795_155_646.1, "since_utc": "2026-11-20T06:20:46.100000000Z", "rows": [_INNER],
        "named": {"a": _INNER, "b": None}, "pair": [3, _INNER], "text": "since",
    }  # fmt: skip


def test_the_schema_describes_the_texts() -> None:
    (root,), kinds = msgspec.json.schema_components([_Outer], ref_template="#/components/schemas/{name}")
    for schema in kinds.values():
        describe(schema)
        schema["additionalProperties"] = False
    document = {**root, "components": {"schemas": kinds}}
    jsonschema_rs.validator_for(document, validate_formats=True).validate(in_full(_outer()))
    wrong = in_full(_outer()) | {"since_utc": "yesterday"}
    assert not jsonschema_rs.validator_for(document, validate_formats=True).is_valid(wrong)


def _bare(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _bare(one) for name, one in value.items() if not name.endswith("_utc")}
    return [_bare(one) for one in value] if isinstance(value, list) else value


@pytest.mark.usefixtures("app")  # tells the contract the type
def test_other_fields_are_unchanged() -> None:
    kinds = [kind for kind in CONTRACT.kinds if UNIT in str(msgspec.json.schema(kind))]
    assert len(kinds) > 15
    for kind in kinds:
        one = example(kind)
        plain = msgspec.json.decode(msgspec.json.encode(one))
        assert _bare(msgspec.json.decode(msgspec.json.encode(in_full(one)))) == plain, kind


def test_an_answer_without_times_is_not_walked() -> None:
    graph = example(Graph)
    assert in_full(graph) is graph


def test_an_invalid_time_is_a_problem_with_a_hint() -> None:
    assert parse_moment("2026-11-20T06:20:46.123456789Z") == 1_795_155_646_123_456_789
    with pytest.raises(ProblemError, match="2026-03-01T12:00:00Z"):
        parse_moment("tomorrow")
