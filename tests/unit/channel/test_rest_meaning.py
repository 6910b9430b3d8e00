import json
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.channel import admin
from appliance.channel.messages.api import ClientRequest
from appliance.channel.operations import OPERATIONS
from appliance.channel.rest_meaning import BadTagError, NoOrderError, RestCall, call_of, filled_in, order_of
from appliance.channel.rest_operation import Operation, plain

ASKED = [operation for operation in OPERATIONS if operation.path]
CHARACTERS = st.characters(codec="utf-8")
BOUNDS = ("ge", "gt", "le", "min_length", "max_length", "pattern")


def values(kind: Any, **bounds: Any) -> st.SearchStrategy[Any]:
    if get_origin(kind) is Annotated:
        inner, *rules = get_args(kind)
        told = ((name, getattr(rule, name)) for rule in rules for name in BOUNDS)
        return values(inner, **{name: bound for name, bound in told if bound is not None})
    size = {"min_size": bounds.get("min_length") or 0, "max_size": min(bounds.get("max_length") or 9, 9)}
    least, above = bounds.get("ge"), bounds.get("gt")
    if get_origin(kind) is Literal:
        return st.sampled_from(get_args(kind))
    if get_origin(kind) is list:
        return st.lists(values(get_args(kind)[0]), min_size=1, max_size=3)
    if get_origin(kind) is dict:
        return st.dictionaries(*map(values, get_args(kind)), min_size=size["min_size"], max_size=3)
    if get_args(kind):
        return st.one_of([values(one) for one in get_args(kind)])
    plainly: dict[Any, st.SearchStrategy[Any]] = {
        bool: st.booleans(), type(None): st.none(),
        int: st.integers(1 if least is None else least, bounds.get("le") or 10**15),
        str: st.from_regex(bounds["pattern"]) if bounds.get("pattern") else st.text(CHARACTERS, **size),
        float: st.floats(above if least is None else least, bounds.get("le"), exclude_min=above is not None,
                         allow_nan=False, allow_infinity=False),
    }  # fmt: skip
    return plainly[kind]


@st.composite
def orders(draw: st.DrawFn, operation: Operation) -> Any:
    fields = dict(operation.fixed)
    for name, field in operation.fields().items():
        if field.name == "expected" or field.name in fields:
            continue
        value = draw(values(field.type))
        if f"{{{name}}}" in operation.path and isinstance(value, list):
            value = value[:1]
        fields[field.name] = value
    return operation.request(**fields)


def request_of(call: RestCall, if_match: str) -> ClientRequest:
    body = b"" if call.body is None else json.dumps(call.body).encode()
    return ClientRequest("10.0.0.1", call.method, call.target, if_match, "application/json", "", body)


@pytest.mark.parametrize(
    "operation", ASKED, ids=lambda one: f"{one.request.__name__} {one.method} {one.path}"
)
@given(data=st.data())
def test_an_order_means_itself(operation: Operation, data: st.DataObject) -> None:
    order = data.draw(orders(operation))
    call = call_of(order, operation)
    if not operation.is_change or "expected" not in operation.fields():
        assert not call.match
        assert filled_in(order_of(request_of(call, "")), order) == order
        return
    assert call.match
    assert filled_in(order_of(request_of(call, "*")), order) == order
    numbered = plain(operation.fields()["expected"].type) is int
    seen = msgspec.structs.replace(order, expected=7 if numbered else "7")
    assert filled_in(order_of(request_of(call, '"7"')), seen) == seen
    for wrong in ("", "7", 'W/"7"', '"7", "8"', '"' + "9" * 91 + '"', '"-1"' if numbered else '""'):
        with pytest.raises(BadTagError):
            order_of(request_of(call, wrong))


@pytest.mark.parametrize(
    "change",
    [
        {"target": "/v1/policy?dry_run=1"}, {"target": "/v1/policy?dry_run=yes"}, {"target": "/v1/policy/"},
        {"method": "GET"}, {"method": "PUT"}, {"target": "/v1/nothing"}, {"if_match": ""}, {"if_match": '"x"'},
        {"body": b"\xff"}, {"content_type": "application/json"}, {"target": "/v1/policy?confirm_within=x"},
        {"body": b"[" * 100_000, "content_type": "application/json"},
        {"body": b"[]", "content_type": "application/json"}, {"target": ""},
        {"body": b'{"text": 7}', "content_type": "application/json"},
    ],
)  # fmt: skip
def test_requests_that_are_not_orders(change: dict[str, Any]) -> None:
    good = ClientRequest("10.0.0.1", "POST", "/v1/policy", "*", "text/plain", "", b"[Nodes]\n")
    assert order_of(good) == admin.PolicyLoad("[Nodes]\n")
    with pytest.raises(NoOrderError):
        order_of(msgspec.structs.replace(good, **change))
