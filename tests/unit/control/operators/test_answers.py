import inspect
import typing
from collections import Counter
from typing import Any, get_args

import pytest

from appliance.channel import admin, messages
from appliance.channel.admin import answer_to
from appliance.channel.channel import ChannelFullError
from appliance.channel.messages import api
from appliance.channel.operations import AnyRequest, RestRequest
from appliance.control.assembly.policies import Policies
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_method import RequestMethod
from appliance.control.operators.request_methods import request_methods
from appliance.control.operators.token_orders import TokenOrders
from appliance.specifications.specification_manager import SpecificationManager
from tests.support.administrations import administration_of
from tests.support.feature_parts import answered_later, idle_parts

CLASSES: dict[str, Any] = {
    "queries": Queries,
    "policies": Policies,
    "monitors": SpecificationManager,
    "tokens": TokenOrders,
}
METHODS = idle_parts().methods() + request_methods(**CLASSES)
OF_FEATURES = answered_later()
REQUESTS: tuple[type[Any], ...] = tuple(dict.fromkeys([*get_args(AnyRequest), *get_args(RestRequest)]))
# Exceptions: a record's fields depend on its event, a child's readiness on its role, the terms of a memory and of work
# on the machine on their feature.
OPEN = {
    ("MonitorEvent", "detail"),
    ("Ready", "detail"),
    ("MemoryGiven", "terms"),
    ("MachineWorkWanted", "terms"),
    ("MachineWorkDone", "found"),
    ("MessageSeen", "fields"),  # a message of any type
    ("MonitorReadout", "values"),  # variables of any type
}
OPEN_OF_FEATURES = {("TopicMessage", "fields")}


def kinds(base: type[Any]) -> set[type[Any]]:
    below = [kinds(subclass) for subclass in base.__subclasses__()]
    return set().union(*below) if below else {base}


def test_every_request_is_in_a_union() -> None:
    assert kinds(admin.AdminRequest) - set(REQUESTS) == set()


def parts(kind: Any, seen: set[Any]) -> typing.Iterator[tuple[Any, str, Any]]:
    if isinstance(kind, type) and hasattr(kind, "__struct_fields__"):
        if kind not in seen:
            seen.add(kind)
            for name, hint in typing.get_type_hints(kind).items():
                if name in kind.__struct_fields__:
                    yield kind, name, hint
                    yield from parts(hint, seen)
        return
    for one in get_args(kind):
        yield from parts(one, seen)


# `RestLink` answers a challenge itself.
ANSWERED = [request for request in REQUESTS if request is not admin.ChallengeWanted]


def test_one_method_answers_each_request() -> None:
    assert Counter([*(method.request for method in METHODS), *OF_FEATURES]) == Counter(ANSWERED)
    for method in METHODS:
        hints = typing.get_type_hints(method.answer)
        given = inspect.signature(method.answer).parameters.values()
        for_others = {one.name for one in given if one.kind is one.KEYWORD_ONLY}
        taken = [hint for name, hint in hints.items() if name not in {"return", *for_others}]
        assert taken == [method.request, *([str] if method.who else [])]


@pytest.mark.anyio
async def test_a_request_without_its_feature_is_unknown() -> None:
    administration = administration_of()
    answer = await administration.carry_out(admin.StatusWanted(), who="operator")
    assert (answer.ok, answer.trouble) == (False, "unknown")


@pytest.mark.anyio
async def test_an_order_to_a_process_that_does_not_read_is_answered() -> None:
    async def answer(_request: admin.StatusWanted) -> Any:
        raise ChannelFullError("a process of the appliance does not read: 9 bytes wait for it")

    administration = administration_of(RequestMethod(admin.StatusWanted, answer))
    given = await administration.carry_out(admin.StatusWanted(), who="operator")
    assert (given.ok, given.trouble) == (False, "failed")
    assert given.error == "a process of the appliance does not read: 9 bytes wait for it"


def test_every_field_between_processes_has_a_type() -> None:
    kinds = [
        *(one for file in (messages, api) for _name, one in inspect.getmembers(file, inspect.isclass)),
        *REQUESTS,
        *map(answer_to, REQUESTS),
    ]
    seen: set[Any] = set()
    found = [
        (kind.__name__, name)
        for one in kinds
        for kind, name, hint in parts(one, seen)
        if hint in (Any, object) or {Any, object} & {*get_args(hint)}
    ]
    assert len(seen) > 100, "the walk goes through all of them"
    assert set(found) - OPEN_OF_FEATURES == OPEN
