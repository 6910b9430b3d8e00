"""The table of the Master API: one row per call. A call that is not here is denied.

The columns are explained at `Call`. To add a call, write its function beside its kin (`registration`, `lookups`,
`parameters`, `parameter_search`) and its row here; the policy knows it by `policy/commands.py` and says what it needs
in `policy/rights.py`.
"""

from appliance.master.calls import lookups, monitor_calls, parameter_search, parameters, registration
from appliance.master.calls.arguments import (
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
)
from appliance.master.calls.call import Answer, Call, Caller, Identity
from appliance.master.graph.registry import Kind

_REGISTRATION = (
    Call(
        "registerPublisher",
        registration.register_publisher,
        (TOPIC, TOPIC_TYPE, CALLER_API),
        denial=[],
        identity=Identity.NODE,
        resource=0,
        api=2,
        registers=Kind.PUBLICATION,
    ),
    Call(
        "unregisterPublisher",
        registration.unregister_publisher,
        (TOPIC, CALLER_API),
        identity=Identity.NODE,
        resource=0,
        api=1,
        gives_up=Kind.PUBLICATION,
    ),
    Call(
        "registerSubscriber",
        registration.register_subscriber,
        (TOPIC, TOPIC_TYPE, CALLER_API),
        denial=[],
        identity=Identity.NODE,
        resource=0,
        api=2,
        registers=Kind.SUBSCRIPTION,
    ),
    Call(
        "unregisterSubscriber",
        registration.unregister_subscriber,
        (TOPIC, CALLER_API),
        identity=Identity.NODE,
        resource=0,
        api=1,
        gives_up=Kind.SUBSCRIPTION,
    ),
    Call(
        "registerService",
        registration.register_service,
        (SERVICE, SERVICE_API, CALLER_API),
        identity=Identity.NODE,
        resource=0,
        api=2,
        registers=Kind.SERVICE,
    ),
    Call(
        "unregisterService",
        registration.unregister_service,
        (SERVICE, SERVICE_API),
        identity=Identity.NODE,
        resource=0,
        gives_up=Kind.SERVICE,
    ),
)

_LOOKUPS = (
    Call("lookupNode", lookups.lookup_node, (NODE,), denial="", reads=True),
    Call(
        "lookupService",
        lookups.lookup_service,
        (SERVICE,),
        denial="",
        resource=0,
        reads=True,
    ),
    Call("getSystemState", lookups.get_system_state, denial=[[], [], []], reads=True),
    Call("getPublishedTopics", lookups.get_published_topics, (SUBGRAPH,), denial=[], reads=True),
    Call("getTopicTypes", lookups.get_topic_types, denial=[], reads=True),
    Call("getUri", lookups.get_uri, denial="", reads=True),
    Call("getPid", lookups.get_pid, denial=-1, reads=True),
    Call("shutdown", lookups.shutdown_master, (MESSAGE,), command="shutdownMaster"),
)

_PARAMETERS = (
    Call("getParam", parameters.get_param, (KEY,), resource=0, reads=True),
    Call("hasParam", parameters.has_param, (KEY,), denial=False, resource=0, reads=True),
    Call("setParam", parameters.set_param, (KEY, VALUE), resource=0),
    Call("deleteParam", parameters.delete_param, (KEY,), resource=0),
    Call("searchParam", parameter_search.search_param, (SEARCH_KEY,), denial="", reads=True),
    Call("getParamNames", parameters.get_param_names, denial=[], reads=True),
    Call(
        "subscribeParam",
        parameters.subscribe_param,
        (CALLER_API, KEY),
        identity=Identity.NODE,
        resource=1,
        api=0,
        registers=Kind.PARAMETER,
    ),
    Call(
        "unsubscribeParam",
        parameters.unsubscribe_param,
        (CALLER_API, KEY),
        identity=Identity.NODE,
        resource=1,
        api=0,
        gives_up=Kind.PARAMETER,
    ),
)


_MONITORS = (
    Call("getMonitors", monitor_calls.get_monitors, denial=[], reads=True),
    Call("monitorControl", monitor_calls.monitor_control, (STATE, MONITORS), denial=[]),
    Call("getRVState", monitor_calls.get_rv_state, denial=[], reads=True),
)


async def list_methods(_master: object, _caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`system.listMethods()`."""
    return [*sorted(MASTER_CALLS), "system.multicall"]


async def method_help(_master: object, _caller: Caller, arguments: tuple[object, ...]) -> str:
    """`system.methodHelp(method_name)`: the first line of the call's documentation."""
    call = MASTER_CALLS.get(str(arguments[0]))
    return (call.perform.__doc__ or "").replace("`", "") if call is not None else ""


async def method_signature(_master: object, _caller: Caller, _arguments: tuple[object, ...]) -> str:
    """`system.methodSignature(method_name)`: Python's servers have none, and say so with these words."""
    return "signatures not supported"


_INTROSPECTION = (
    Call("system.listMethods", list_methods, denial=[], identity=Identity.NOBODY, command="listMethods"),
    Call(
        "system.methodHelp", method_help, (METHOD,), denial="", identity=Identity.NOBODY, command="methodHelp"
    ),
    Call(
        "system.methodSignature",
        method_signature,
        (METHOD,),
        denial="",
        identity=Identity.NOBODY,
        command="methodSignature",
    ),
)

MASTER_CALLS: dict[str, Call] = {
    call.name: call for call in (*_REGISTRATION, *_LOOKUPS, *_PARAMETERS, *_MONITORS, *_INTROSPECTION)
}
