"""What crosses from process to process is said with types, and every question has one method that answers it."""

import inspect
import typing
from typing import Any, get_args

import pytest

from appliance.channel import admin, messages
from appliance.channel.admin import answer_to
from appliance.channel.answers.graph_answers import TopicMessage
from appliance.channel.messages import api
from appliance.control.administration import Orders, request_of
from appliance.control.queries import Looks

METHODS = [
    method
    for part in (Looks, *get_args(Orders))
    for _name, method in inspect.getmembers(part, inspect.iscoroutinefunction)
]
REQUESTS: tuple[type[Any], ...] = tuple(
    dict.fromkeys([*get_args(admin.AnyRequest), *get_args(admin.RestRequest)])
)
# The fields of a record, which each event has of its own; what a child has ready, which each role has of its own.
OPEN = {
    (messages.MonitorEvent, "detail"),
    (messages.Ready, "detail"),
    (messages.MessageSeen, "fields"),  # a message of whatever type
    (TopicMessage, "fields"),
}


def kinds(base: type[Any]) -> set[type[Any]]:
    """Every request that is written: what has a tag of its own and nothing below it."""
    below = [kinds(one) for one in base.__subclasses__()]
    return set().union(*below) if below else {base}


def test_every_request_that_is_written_can_be_asked() -> None:
    """None is missing in the unions of what the admin socket and the link to the api take."""
    assert kinds(admin.AdminRequest) - set(REQUESTS) == set()


def taken(method: Any) -> Any:
    """The request that a method of a class takes; the first parameter is `self`."""
    kind, _names = request_of(typing.cast(Any, method).__get__(object()))
    return kind


def parts(kind: Any, seen: set[Any]) -> typing.Iterator[tuple[Any, str, Any]]:
    """Every field of a struct and of the structs in it: the struct, the name, the annotation."""
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


# `RestLink` answers a challenge itself: it is of the link, not of the appliance.
ANSWERED = [one for one in REQUESTS if one is not admin.ChallengeWanted]


@pytest.mark.parametrize("request_kind", ANSWERED, ids=lambda kind: kind.__name__)
def test_one_method_answers_each_request_with_what_is_said(request_kind: Any) -> None:
    """The method is found by the request it takes, and gives the struct that the request names."""
    (method,) = [one for one in METHODS if taken(one) is request_kind]
    assert typing.get_type_hints(method)["return"] is answer_to(request_kind)


def test_nothing_without_a_type_crosses_between_processes() -> None:
    """No message, request or answer has a field that may hold anything: `Any`, `object`, `dict[str, Any]`."""
    kinds = [
        *(one for file in (messages, api) for _name, one in inspect.getmembers(file, inspect.isclass)),
        *REQUESTS,
        *map(answer_to, REQUESTS),
    ]
    seen: set[Any] = set()
    found = [
        (kind, name)
        for one in kinds
        for kind, name, hint in parts(one, seen)
        if hint in (Any, object) or {Any, object} & {*get_args(hint)}
    ]
    assert len(seen) > 100, "the walk goes through all of them"
    assert set(found) == OPEN
