"""Messages between processes are typed, and each request has one method that answers it."""

import inspect
import typing
from collections import Counter
from typing import Any, get_args

from appliance.channel import admin, messages
from appliance.channel.admin import answer_to, methods_of
from appliance.channel.answers.graph_answers import TopicMessage
from appliance.channel.messages import api
from appliance.control.administration import Orders
from appliance.control.queries import Queries

MARKED = [marked for part in (Queries, *get_args(Orders)) for marked in methods_of(part)]
REQUESTS: tuple[type[Any], ...] = tuple(
    dict.fromkeys([*get_args(admin.AnyRequest), *get_args(admin.RestRequest)])
)
# Exceptions: a record's fields depend on its event, and a child's readiness on its role.
OPEN = {
    (messages.MonitorEvent, "detail"),
    (messages.Ready, "detail"),
    (messages.MessageSeen, "fields"),  # a message of any type
    (TopicMessage, "fields"),
}


def kinds(base: type[Any]) -> set[type[Any]]:
    """Return every request: a struct with its own tag and no subclass."""
    below = [kinds(one) for one in base.__subclasses__()]
    return set().union(*below) if below else {base}


def test_every_request_is_in_a_union() -> None:
    """The unions of the admin socket and of the link to the api are complete."""
    assert kinds(admin.AdminRequest) - set(REQUESTS) == set()


def parts(kind: Any, seen: set[Any]) -> typing.Iterator[tuple[Any, str, Any]]:
    """Yield every field of a struct and its nested structs: struct, name, annotation."""
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
ANSWERED = [one for one in REQUESTS if one is not admin.ChallengeWanted]


def test_one_method_answers_each_request() -> None:
    """Each request has exactly one method, which takes the request as its argument; mypy compares the answers."""
    assert Counter(mark.request for mark, _method in MARKED) == Counter(ANSWERED)
    for mark, method in MARKED:
        hints = typing.get_type_hints(method)
        del hints["return"]
        assert list(hints.values()) == [mark.request, str] if mark.who else [mark.request], method


def test_every_field_between_processes_has_a_type() -> None:
    """No message, request or answer has a field of type `Any`, `object` or `dict[str, Any]`."""
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
