"""The calls that make a node part of the graph, or take it out: topics and services.

A registration outlasts control before its node is told of it (the store writes ahead): a ROS 1 node never registers
twice, and ROSMaster, which knows the rest, can die in the same moment as control.
"""

import contextlib
from collections.abc import AsyncIterator, Iterable
from typing import TYPE_CHECKING, cast

from appliance.master.calls.arguments import ApiUri
from appliance.master.calls.call import Answer, Call, Caller
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration
from appliance.ros.uris import service_uri

if TYPE_CHECKING:
    from appliance.master.core import Master


async def register_publisher(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`registerPublisher(caller_id, topic, topic_type, caller_api)` → the subscribers' (outer) URIs."""
    topic, topic_type, api = str(arguments[0]), str(arguments[1]), cast(ApiUri, arguments[2])
    async with registering(master, caller, api) as incarnation:
        inner = master.faces.inner_uri(incarnation)
        answer = await master.rosmaster.call("registerPublisher", caller.caller_id, topic, topic_type, inner)
        if answer[0] == 1:
            master.graph.registered(incarnation, Kind.PUBLICATION, topic, topic_type)
            hidden = master.mediation.hides_publishers(topic)
            answer[2] = list(master.registry.uris_for(incarnation, Kind.SUBSCRIPTION, topic, hidden=hidden))
        return answer


async def register_subscriber(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`registerSubscriber(caller_id, topic, topic_type, caller_api)` → the publishers' (outer) URIs."""
    topic, topic_type, api = str(arguments[0]), str(arguments[1]), cast(ApiUri, arguments[2])
    async with registering(master, caller, api) as incarnation:
        inner = master.faces.inner_uri(incarnation)
        answer = await master.rosmaster.call("registerSubscriber", caller.caller_id, topic, topic_type, inner)
        if answer[0] == 1:
            master.graph.registered(incarnation, Kind.SUBSCRIPTION, topic, topic_type)
            answer[2] = list(master.graph.list_for(incarnation, topic))
        return answer


async def register_service(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`registerService(caller_id, service, service_api, caller_api)`."""
    service, service_api, api = str(arguments[0]), cast(ApiUri, arguments[1]), cast(ApiUri, arguments[2])
    async with registering(master, caller, api) as incarnation:
        inner = master.faces.inner_uri(incarnation)
        answer = await master.rosmaster.call(
            "registerService", caller.caller_id, service, stand_in(incarnation), inner
        )
        if answer[0] == 1:
            master.graph.registered(incarnation, Kind.SERVICE, service, str(service_api.uri.port))
        return answer


async def unregister_publisher(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`unregisterPublisher(caller_id, topic, caller_api)`."""
    return await _unregister(master, caller, "unregisterPublisher", Kind.PUBLICATION, arguments)


async def unregister_subscriber(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`unregisterSubscriber(caller_id, topic, caller_api)`."""
    return await _unregister(master, caller, "unregisterSubscriber", Kind.SUBSCRIPTION, arguments)


async def unregister_service(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`unregisterService(caller_id, service, service_api)`: the caller's node is found by what it offers."""
    service, service_api = str(arguments[0]), cast(ApiUri, arguments[1])
    port = service_api.uri.port
    provider = next(
        (
            one
            for one in master.registry.registered(Kind.SERVICE, service)
            if one.name == caller.caller_id
            # By its own port, or as `rosnode cleanup` does, by the one that lookupService told.
            and (
                one.registrations[Kind.SERVICE, service].detail == str(port)
                or master.relay.port(one, Kind.SERVICE, service) == port
            )
        ),
        None,
    )
    uri = stand_in(provider) if provider is not None else NO_SERVICE
    answer = await master.rosmaster.call("unregisterService", caller.caller_id, service, uri)
    _speak_as_asked(answer, uri, service_api)
    if answer[0] == 1 and provider is not None:
        master.graph.unregistered(provider, Kind.SERVICE, service)
    return answer


def given_up(master: "Master", caller: Caller, call: Call, arguments: tuple[object, ...]) -> None:
    """A node gives up what the policy has taken from it (it is denied that): it is not to be put back one day."""
    kind = call.gives_up
    if kind is None or call.resource is None:
        return
    resource = str(arguments[call.resource])
    asked = next(one for one in arguments if isinstance(one, ApiUri))
    for one in master.registry.all():
        shelved = one.shelf.get((kind, resource))
        if shelved is None or (one.name, one.host) != (caller.caller_id, caller.peer.host):
            continue
        by_port = kind is Kind.SERVICE and shelved.detail == str(asked.uri.port)
        if by_port or one.api_text == asked.text:
            master.registry.unshelve(one, kind, resource)


async def _unregister(
    master: "Master", caller: Caller, method: str, kind: Kind, arguments: tuple[object, ...]
) -> Answer:
    resource, api = str(arguments[0]), cast(ApiUri, arguments[1])
    incarnation = master.faces.known(caller, api) or _told_as(master, caller, api)
    inner = master.faces.inner_uri(incarnation) if incarnation is not None else master.faces.nobody()
    answer = await master.rosmaster.call(method, caller.caller_id, resource, inner)
    _speak_as_asked(answer, inner, api)
    if answer[0] == 1 and incarnation is not None:
        master.graph.unregistered(incarnation, kind, resource)
    return answer


def _told_as(master: "Master", caller: Caller, api: ApiUri) -> Incarnation | None:
    """The node that the caller speaks for by the URI that lookupNode told, as `rosnode cleanup` does on its host."""
    holder = master.registry.holder(caller.caller_id)
    meant = holder is not None and (holder.host, holder.outer_port) == (caller.peer.host, api.uri.port)
    return holder if meant else None


@contextlib.asynccontextmanager
async def registering(master: "Master", caller: Caller, api: ApiUri) -> AsyncIterator[Incarnation]:
    """The incarnation that registers, which makes room for nobody meanwhile.

    A new one takes the room of one of its host's that has nothing or is gone.
    """
    spare = master.gate.to_make_room(caller, api)
    if spare is not None:
        master.graph.forgotten(spare)
    incarnation = await master.faces.incarnation_for(caller, api)
    while master.registry.by_key(incarnation.key) is not incarnation:  # it made room before this went on
        incarnation = await master.faces.incarnation_for(caller, api)
    incarnation.calls += 1
    try:
        yield incarnation
    finally:
        incarnation.calls -= 1


def _speak_as_asked(answer: Answer, told: str, asked: ApiUri) -> None:
    """ROSMaster's words may repeat the URI it was told, which is nobody's business: the caller reads his own."""
    answer[1] = str(answer[1]).replace(told, asked.text)


async def withdraw(master: "Master", incarnation: Incarnation, kind: Kind, resource: str) -> None:
    """Unregister something at ROSMaster for a node that is gone or may not have it any more."""
    inner = master.faces.inner_uri(incarnation)
    match kind:
        case Kind.PUBLICATION:
            await master.rosmaster.call("unregisterPublisher", incarnation.name, resource, inner)
        case Kind.SUBSCRIPTION:
            await master.rosmaster.call("unregisterSubscriber", incarnation.name, resource, inner)
        case Kind.SERVICE:
            await master.rosmaster.call(
                "unregisterService", incarnation.name, resource, stand_in(incarnation)
            )
        case Kind.PARAMETER:
            await master.rosmaster.call("unsubscribeParam", incarnation.name, inner, resource)


async def withdraw_lost(
    master: "Master", incarnation: Incarnation, registrations: Iterable[Registration]
) -> None:
    """Unregister what a lost node had; what is left of it stays when it comes back meanwhile."""
    for one in registrations:
        if incarnation.life is Life.LIVE:
            return
        await withdraw(master, incarnation, one.kind, one.resource)


def stand_in(incarnation: Incarnation) -> str:
    """The service URI that ROSMaster has for every service of an incarnation; nobody is ever told it."""
    return service_uri(incarnation.key, incarnation.relay_port)


def key_of_stand_in(uri: str) -> str:
    """The key of the incarnation behind a stand-in."""
    return uri.removeprefix("rosrpc://").partition(":")[0]


NO_SERVICE = "rosrpc://nobody:1"
