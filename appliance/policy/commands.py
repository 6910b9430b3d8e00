"""The policy's table of calls. `[Commands]`, rights and dry runs are derived from its rows.

A call without a row is unknown and always denied; `default` does not grant it.
"""

from typing import NamedTuple

from appliance.policy.model import Category

_PUBLISHERS, _SUBSCRIBERS, _SERVICES = (
    f"[Nodes] and [{name}]" for name in ("Publishers", "Subscribers", "Services")
)


class PolicyCall(NamedTuple):
    """One call; its key in the table is its name in the policy.

    elsewhere     the sections that decide the call, if `[Commands]` does not
    node          the call adds a node to the graph or removes it, so `[Nodes]` also decides
    gives         the thing that the call gives the caller, such as a publication, until it is revoked
    silent        the answer reveals nothing about the parameter's value
    named_only    only its own key grants the call, never `default`: it ends the appliance or reveals hidden data
    at_start      why an unmodified rospy or roscpp node makes the call while it starts
    wire          the longer name of the call on the wire
    """

    category: Category = Category.COMMAND
    elsewhere: str = ""
    touches: Category | None = None
    node: bool = False
    gives: str = ""
    silent: bool = False
    named_only: bool = False
    at_start: str = ""
    wire: str = ""


class _Calls(dict[str, PolicyCall]):
    def __missing__(self, name: str) -> PolicyCall:
        return _COMMAND


_COMMAND = PolicyCall()
CALLS = _Calls(
    {
        # Master API: the graph
        "registerPublisher": PolicyCall(Category.PUBLISH, _PUBLISHERS, node=True, gives="publication"),
        "unregisterPublisher": PolicyCall(Category.PUBLISH, _PUBLISHERS, node=True),
        "registerSubscriber": PolicyCall(Category.SUBSCRIBE, _SUBSCRIBERS, node=True, gives="subscription"),
        "unregisterSubscriber": PolicyCall(Category.SUBSCRIBE, _SUBSCRIBERS, node=True),
        "registerService": PolicyCall(Category.OFFER, _SERVICES, node=True, gives="service"),
        "unregisterService": PolicyCall(Category.OFFER, _SERVICES, node=True),
        "lookupService": PolicyCall(Category.CALL, gives="call"),
        "lookupNode": _COMMAND,
        "getSystemState": _COMMAND,
        "getPublishedTopics": _COMMAND,
        "getTopicTypes": _COMMAND,
        "getUri": _COMMAND,
        "getPid": _COMMAND,
        # parameters
        "getParam": PolicyCall(
            touches=Category.READ, at_start="rospy and roscpp read /use_sim_time with it when they start"
        ),
        "setParam": PolicyCall(touches=Category.WRITE),
        "hasParam": PolicyCall(
            touches=Category.READ, at_start="roscpp looks for /use_sim_time with it when it starts"
        ),
        "deleteParam": PolicyCall(touches=Category.WRITE),
        "searchParam": _COMMAND,
        "getParamNames": _COMMAND,
        "subscribeParam": PolicyCall(touches=Category.READ, node=True, gives="parameter"),
        "unsubscribeParam": PolicyCall(touches=Category.READ, node=True, silent=True),
        # node API; a node that calls requestTopic has subscribed to the topic
        "requestTopic": PolicyCall(Category.SUBSCRIBE, _SUBSCRIBERS, node=True, gives="subscription"),
        "getBusInfo": _COMMAND,
        "getBusStats": _COMMAND,
        "getMasterUri": _COMMAND,
        "getSubscriptions": _COMMAND,
        "getPublications": _COMMAND,
        "getName": _COMMAND,
        "shutdown": _COMMAND,
        "publisherUpdate": PolicyCall(elsewhere="no rule: only the master sends it"),
        "paramUpdate": PolicyCall(elsewhere="no rule: only the master sends it"),
        # the XML-RPC server
        "system.multicall": PolicyCall(elsewhere="the rules of each of its parts"),
        "listMethods": PolicyCall(wire="system.listMethods"),
        "methodHelp": PolicyCall(wire="system.methodHelp"),
        "methodSignature": PolicyCall(wire="system.methodSignature"),
        # RVMaster's own
        "getMonitors": _COMMAND,
        "monitorControl": _COMMAND,
        "getRVState": PolicyCall(named_only=True),
        "shutdownMaster": PolicyCall(named_only=True),
    }
)

COMMANDS = frozenset(name for name, call in CALLS.items() if not call.elsewhere)
"""The calls that `[Commands]` may grant."""

NAMED_ONLY = frozenset(name for name, call in CALLS.items() if call.named_only)
DECIDED_ELSEWHERE = {name: call.elsewhere for name, call in CALLS.items() if call.elsewhere}
ALIASES = {call.wire: name for name, call in CALLS.items() if call.wire}
