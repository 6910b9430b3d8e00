"""The calls of ROSRV's tools: which monitors there are, which are enabled, where their topics are carried."""

from typing import TYPE_CHECKING, cast

from appliance.master.calls.call import Answer, Caller
from appliance.master.graph.registry import Kind
from appliance.ros.xmlrpc import Value
from appliance.specifications.monitors import UnknownMonitorError

if TYPE_CHECKING:
    from appliance.master.core import Master

_WORDS = {"enable": True, "disable": False}
_NOBODY = (0, 0)


async def get_monitors(master: "Master", _caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getMonitors(caller_id)` → `[[name, enabled], …]`."""
    monitors = master.monitors
    return [1, "Monitors", [[name, monitors.enabled(name)] for name in monitors.names()]]


async def monitor_control(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`monitorControl(caller_id, "enable"|"disable", [names])` → the names that were switched."""
    word, names = str(arguments[0]), cast(list[str], arguments[1])
    if word not in _WORDS:
        return [-1, f"{word[:80]!r} is not to be done with monitors: enable or disable", []]
    try:
        changed = await master.monitors.switch(
            names, _WORDS[word], who=f"{caller.caller_id} ({caller.peer.text})"
        )
    except UnknownMonitorError as error:
        return [-1, str(error), []]
    return [1, f"{word}d {', '.join(changed) or 'nothing: it was so already'}", cast(list[Value], changed)]


async def get_rv_state(master: "Master", _caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getRVState(caller_id)` → `[real port, RVMaster's port, [[monitor, topic, XML-RPC port, TCP port], …]]`.

    The ports are those that stand for each publisher of the topic; 0 for a topic that nobody publishes.
    """
    return [1, "RV State", cast(Value, rv_state(master))]


def rv_state(master: "Master") -> list[object]:
    """The value of `getRVState`."""
    rows: list[list[object]] = []
    for monitor, topics in master.monitors.checked.topics.items():
        for topic in sorted(topics):
            ports = [
                (publisher.outer_port, master.relay.port(publisher, Kind.PUBLICATION, topic))
                for publisher in master.registry.registered(Kind.PUBLICATION, topic)
            ]
            rows += [[monitor, topic, *pair] for pair in ports or [_NOBODY]]
    return [master.rosmaster.port, master.port, rows]
