"""The table of the Master API: one row per call. A call that is not here is denied.

The columns are explained at `Call`. To add a call, write its method beside its kin (`registration`, `lookups`,
`parameters`, `parameter_search`, `monitor_calls`) and its row here; the policy knows it by `policy/commands.py`, and
`policy/rights.py` says what it needs where that is more than the right to the command.
"""

from typing import Any

from appliance.master.caller import Answer, Caller
from appliance.master.calls.call import (
    CALLER_API,
    KEY,
    MESSAGE,
    METHOD,
    MONITORS,
    NODE,
    SEARCH_KEY,
    SERVICE,
    SERVICE_API,
    STATE,
    SUBGRAPH,
    TOPIC,
    TOPIC_TYPE,
    VALUE,
    Call,
    Identity,
    Table,
    Verb,
    method,
    served,
)
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterSearch
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.graph.registry import Kind

_REGISTRATION: tuple[Call[RegistrationCalls], ...] = (
    Call(
        "registerPublisher",
        method(RegistrationCalls.register_publisher, TOPIC, TOPIC_TYPE, CALLER_API),
        Verb.REGISTER,
        Kind.PUBLICATION,
        denial=[],
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "unregisterPublisher",
        method(RegistrationCalls.unregister_publisher, TOPIC, CALLER_API),
        Verb.UNREGISTER,
        Kind.PUBLICATION,
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "registerSubscriber",
        method(RegistrationCalls.register_subscriber, TOPIC, TOPIC_TYPE, CALLER_API),
        Verb.REGISTER,
        Kind.SUBSCRIPTION,
        denial=[],
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "unregisterSubscriber",
        method(RegistrationCalls.unregister_subscriber, TOPIC, CALLER_API),
        Verb.UNREGISTER,
        Kind.SUBSCRIPTION,
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "registerService",
        method(RegistrationCalls.register_service, SERVICE, SERVICE_API, CALLER_API),
        Verb.REGISTER,
        Kind.SERVICE,
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "unregisterService",
        method(RegistrationCalls.unregister_service, SERVICE, SERVICE_API),
        Verb.UNREGISTER,
        Kind.SERVICE,
        identity=Identity.NODE,
        small=True,
    ),
    Call(
        "subscribeParam",
        method(RegistrationCalls.subscribe_param, CALLER_API, KEY),
        Verb.REGISTER,
        Kind.PARAMETER,
        identity=Identity.NODE,
        tells=True,
    ),
    Call(
        "unsubscribeParam",
        method(RegistrationCalls.unsubscribe_param, CALLER_API, KEY),
        Verb.UNREGISTER,
        Kind.PARAMETER,
        identity=Identity.NODE,
        small=True,
    ),
)

_LOOKUPS: tuple[Call[LookupCalls], ...] = (
    Call("lookupNode", method(LookupCalls.lookup_node, NODE), Verb.READ, denial="", small=True),
    Call(
        "lookupService",
        method(LookupCalls.lookup_service, SERVICE),
        Verb.CONNECT,
        Kind.SERVICE,
        denial="",
        small=True,
    ),
    Call("getSystemState", method(LookupCalls.get_system_state), Verb.READ, denial=[[], [], []]),
    Call("getPublishedTopics", method(LookupCalls.get_published_topics, SUBGRAPH), Verb.READ, denial=[]),
    Call("getTopicTypes", method(LookupCalls.get_topic_types), Verb.READ, denial=[]),
    Call("getUri", method(LookupCalls.get_uri), Verb.READ, denial=""),
    Call("getPid", method(LookupCalls.get_pid), Verb.READ, denial=-1),
    Call("shutdown", method(LookupCalls.shutdown_master, MESSAGE), Verb.DO, command="shutdownMaster"),
)

_PARAMETERS: tuple[Call[ParameterCalls], ...] = (
    Call(
        "getParam", method(ParameterCalls.get_param, KEY), Verb.READ, Kind.PARAMETER, tells=True, in_run=True
    ),
    Call(
        "hasParam",
        method(ParameterCalls.has_param, KEY),
        Verb.READ,
        Kind.PARAMETER,
        denial=False,
        small=True,
        in_run=True,
    ),
    Call("setParam", method(ParameterCalls.set_param, KEY, VALUE), Verb.WRITE, Kind.PARAMETER, in_run=True),
    Call("deleteParam", method(ParameterCalls.delete_param, KEY), Verb.WRITE, Kind.PARAMETER, in_run=True),
    Call("getParamNames", method(ParameterCalls.get_param_names), Verb.READ, denial=[]),
)

_SEARCH: tuple[Call[ParameterSearch], ...] = (
    Call("searchParam", method(ParameterSearch.search_param, SEARCH_KEY), Verb.READ, denial="", small=True),
)

_MONITORS: tuple[Call[MonitorCalls], ...] = (
    Call("getMonitors", method(MonitorCalls.get_monitors), Verb.READ, denial=[]),
    Call("monitorControl", method(MonitorCalls.monitor_control, STATE, MONITORS), Verb.DO, denial=[]),
    Call("getRVState", method(MonitorCalls.get_rv_state), Verb.READ, denial=[]),
)


class Introspection:
    """What XML-RPC servers tell of themselves."""

    async def list_methods(self, _caller: Caller) -> Answer:
        """`system.listMethods()`."""
        return [*sorted(MASTER_CALLS), "system.multicall"]

    async def method_help(self, _caller: Caller, name: str) -> str:
        """`system.methodHelp(method_name)`: the first line of the call's documentation."""
        call = MASTER_CALLS.get(name)
        return (call.method.perform.__doc__ or "").replace("`", "") if call is not None else ""

    async def method_signature(self, _caller: Caller, _name: str) -> str:
        """`system.methodSignature(method_name)`: Python's servers have none, and say so with these words."""
        return "signatures not supported"


_INTROSPECTION: tuple[Call[Introspection], ...] = (
    Call(
        "system.listMethods",
        method(Introspection.list_methods),
        Verb.READ,
        denial=[],
        identity=Identity.NOBODY,
        command="listMethods",
    ),
    Call(
        "system.methodHelp",
        method(Introspection.method_help, METHOD),
        Verb.READ,
        denial="",
        identity=Identity.NOBODY,
        command="methodHelp",
    ),
    Call(
        "system.methodSignature",
        method(Introspection.method_signature, METHOD),
        Verb.READ,
        denial="",
        identity=Identity.NOBODY,
        command="methodSignature",
    ),
)

MASTER_CALLS: dict[str, Call[Any]] = {
    call.name: call
    for rows in (_REGISTRATION, _LOOKUPS, _PARAMETERS, _SEARCH, _MONITORS, _INTROSPECTION)
    for call in rows
}


def master_table(
    registration: RegistrationCalls,
    lookups: LookupCalls,
    parameters: ParameterCalls,
    search: ParameterSearch,
    monitors: MonitorCalls,
) -> Table:
    """The Master API, carried out by these parts."""
    return {
        **served(_REGISTRATION, registration),
        **served(_LOOKUPS, lookups),
        **served(_PARAMETERS, parameters),
        **served(_SEARCH, search),
        **served(_MONITORS, monitors),
        **served(_INTROSPECTION, Introspection()),
    }
