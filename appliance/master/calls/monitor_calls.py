"""Answer the calls of ROSRV's tools, which list and switch monitors and locate their topics."""

from dataclasses import dataclass
from typing import cast

from appliance.channel.admin import MonitorSwitch
from appliance.master.calls.call import Caller
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.registry import Kind, Registry
from appliance.master.rosmaster import Answer
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager, UnknownMonitorError
from roswire.xmlrpc import Value

_WORDS = {"enable": True, "disable": False}
_NOBODY = (0, 0)


@dataclass(frozen=True, slots=True)
class MonitorCalls:
    """The calls about monitors. `port` is RVMaster's."""

    monitors: SpecificationManager
    registry: Registry
    relay: RelayControl
    real_port: int
    port: int

    async def get_monitors(self, _caller: Caller) -> Answer:
        """`getMonitors(caller_id)` → `[[name, enabled], …]`."""
        return [
            1,
            "Monitors",
            [[name, self.monitors.switches.is_enabled(name)] for name in self.monitors.names()],
        ]

    async def monitor_control(self, caller: Caller, word: str, names: list[str]) -> Answer:
        """`monitorControl(caller_id, "enable"|"disable", [names])` → the names that were switched."""
        if word not in _WORDS:
            return [-1, f"{word[:80]!r} is not a valid order for monitors: use enable or disable", []]
        try:
            order = MonitorSwitch(names, _WORDS[word])
            changed = (await self.monitors.switch(order, f"{caller.caller_id} ({caller.peer.text})")).names
        except (UnknownMonitorError, SpecificationsRefusedError) as error:
            return [-1, str(error), []]
        return [
            1,
            f"{word}d {', '.join(changed) or 'nothing: no change was needed'}",
            cast(list[Value], changed),
        ]

    async def get_rv_state(self, _caller: Caller) -> Answer:
        """`getRVState(caller_id)` → `[real port, RVMaster's port, [[monitor, topic, XML-RPC port, TCP port], …]]`.

        The ports are those of each publisher's proxy endpoint and relay; 0 for a topic without a publisher.
        """
        return [1, "RV State", cast(Value, self.rv_state())]

    def rv_state(self) -> list[object]:
        rows: list[list[object]] = []
        for monitor, topics in self.monitors.checked.topics.items():
            for topic in sorted(topics):
                ports = [
                    (publisher.outer_port, self.relay.port(publisher, Kind.PUBLICATION, topic))
                    for publisher in self.registry.registrants(Kind.PUBLICATION, topic)
                ]
                rows += [[monitor, topic, *pair] for pair in ports or [_NOBODY]]
        return [self.real_port, self.port, rows]
