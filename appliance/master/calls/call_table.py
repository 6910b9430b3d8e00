"""Define the table of the Master API. Calls without a row are denied."""

from typing import Any

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
    Caller,
    CallVerb,
    RosCall,
    Table,
    method,
    served_calls,
)
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.parameter_calls import ParameterCalls
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.graph.registry import Kind
from appliance.master.rosmaster import Answer


class Introspection:
    """The introspection calls of an XML-RPC server."""

    async def list_methods(self, _caller: Caller) -> Answer:
        """`system.listMethods()`."""
        return [*sorted(MASTER_CALLS), "system.multicall"]

    async def method_help(self, _caller: Caller, name: str) -> str:
        """`system.methodHelp(method_name)`: the call's documentation."""
        call = MASTER_CALLS.get(name)
        return (call.method.perform.__doc__ or "").replace("`", "") if call is not None else ""

    async def method_signature(self, _caller: Caller, _name: str) -> str:
        """`system.methodSignature(method_name)`: the same answer as Python's XML-RPC servers."""
        return "signatures not supported"


# fmt: off
_REGISTRATION: tuple[RosCall[RegistrationCalls], ...] = (
    RosCall("registerPublisher", method(RegistrationCalls.register_publisher, TOPIC, TOPIC_TYPE, CALLER_API),
            CallVerb.REGISTER, Kind.PUBLICATION, denial=[]),
    RosCall("unregisterPublisher", method(RegistrationCalls.unregister_publisher, TOPIC, CALLER_API),
            CallVerb.UNREGISTER, Kind.PUBLICATION),
    RosCall("registerSubscriber", method(RegistrationCalls.register_subscriber, TOPIC, TOPIC_TYPE, CALLER_API),
            CallVerb.REGISTER, Kind.SUBSCRIPTION, denial=[]),
    RosCall("unregisterSubscriber", method(RegistrationCalls.unregister_subscriber, TOPIC, CALLER_API),
            CallVerb.UNREGISTER, Kind.SUBSCRIPTION),
    RosCall("registerService", method(RegistrationCalls.register_service, SERVICE, SERVICE_API, CALLER_API),
            CallVerb.REGISTER, Kind.SERVICE),
    RosCall("unregisterService", method(RegistrationCalls.unregister_service, SERVICE, SERVICE_API),
            CallVerb.UNREGISTER, Kind.SERVICE),
    RosCall("subscribeParam", method(RegistrationCalls.subscribe_param, CALLER_API, KEY),
            CallVerb.REGISTER, Kind.PARAMETER, tells=True),
    RosCall("unsubscribeParam", method(RegistrationCalls.unsubscribe_param, CALLER_API, KEY),
            CallVerb.UNREGISTER, Kind.PARAMETER),
)
_LOOKUPS: tuple[RosCall[LookupCalls], ...] = (
    RosCall("lookupNode", method(LookupCalls.lookup_node, NODE), CallVerb.READ, denial=""),
    RosCall("lookupService", method(LookupCalls.lookup_service, SERVICE),
            CallVerb.CONNECT, Kind.SERVICE, denial=""),
    RosCall("getSystemState", method(LookupCalls.get_system_state), CallVerb.READ, denial=[[], [], []]),
    RosCall("getPublishedTopics", method(LookupCalls.get_published_topics, SUBGRAPH), CallVerb.READ, denial=[]),
    RosCall("getTopicTypes", method(LookupCalls.get_topic_types), CallVerb.READ, denial=[]),
    RosCall("getUri", method(LookupCalls.get_uri), CallVerb.READ, denial=""),
    RosCall("getPid", method(LookupCalls.get_pid), CallVerb.READ, denial=-1),
    RosCall("shutdown", method(LookupCalls.shutdown_master, MESSAGE), CallVerb.DO, command="shutdownMaster"),
)
_PARAMETERS: tuple[RosCall[ParameterCalls], ...] = (
    RosCall("getParam", method(ParameterCalls.get_param, KEY),
            CallVerb.READ, Kind.PARAMETER, tells=True, in_run=True),
    RosCall("hasParam", method(ParameterCalls.has_param, KEY),
            CallVerb.READ, Kind.PARAMETER, denial=False, in_run=True),
    RosCall("setParam", method(ParameterCalls.set_param, KEY, VALUE), CallVerb.WRITE, Kind.PARAMETER, in_run=True),
    RosCall("deleteParam", method(ParameterCalls.delete_param, KEY), CallVerb.WRITE, Kind.PARAMETER, in_run=True),
    RosCall("getParamNames", method(ParameterCalls.get_param_names), CallVerb.READ, denial=[]),
    RosCall("searchParam", method(ParameterCalls.search_param, SEARCH_KEY), CallVerb.READ, denial=""),
)
_MONITORS: tuple[RosCall[MonitorCalls], ...] = (
    RosCall("getMonitors", method(MonitorCalls.get_monitors), CallVerb.READ, denial=[]),
    RosCall("monitorControl", method(MonitorCalls.monitor_control, STATE, MONITORS), CallVerb.DO, denial=[]),
    RosCall("getRVState", method(MonitorCalls.get_rv_state), CallVerb.READ, denial=[]),
)
_INTROSPECTION: tuple[RosCall[Introspection], ...] = (
    RosCall("system.listMethods", method(Introspection.list_methods), CallVerb.READ, denial=[]),
    RosCall("system.methodHelp", method(Introspection.method_help, METHOD), CallVerb.READ, denial=""),
    RosCall("system.methodSignature", method(Introspection.method_signature, METHOD), CallVerb.READ, denial=""),
)
# fmt: on

MASTER_CALLS: dict[str, RosCall[Any]] = {
    call.name: call
    for rows in (_REGISTRATION, _LOOKUPS, _PARAMETERS, _MONITORS, _INTROSPECTION)
    for call in rows
}


def master_table(
    registration: RegistrationCalls,
    lookups: LookupCalls,
    parameters: ParameterCalls,
    monitors: MonitorCalls,
) -> Table:
    return {
        **served_calls(_REGISTRATION, registration),
        **served_calls(_LOOKUPS, lookups),
        **served_calls(_PARAMETERS, parameters),
        **served_calls(_MONITORS, monitors),
        **served_calls(_INTROSPECTION, Introspection()),
    }
