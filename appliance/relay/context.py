"""The objects that the parts of one relay share."""

from dataclasses import dataclass

from appliance.relay.grant_table import GrantTable
from appliance.relay.loop import EventLoop
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.report import Reporter
from appliance.relay.transport.frames import Scratch
from appliance.relay.transport.memory import RelayMemory


@dataclass(frozen=True, slots=True)
class RelayContext:
    """The shared objects of one relay."""

    loop: EventLoop
    limits: RelayLimits
    reporter: Reporter
    memory: RelayMemory
    scratch: Scratch
    interceptor: Interceptor
    table: GrantTable

    def payer(self, host: str) -> str:
        """Return the payer for the processor time of a host."""
        return self.table.payer(host)

    @property
    def unsettled(self) -> bool:
        """Whether control has not stated all facts, or specifications are not in force yet."""
        return self.table.restating or self.interceptor.preparing

    @classmethod
    def of(
        cls,
        loop: EventLoop,
        limits: RelayLimits,
        reporter: Reporter,
        interceptor: Interceptor,
        table: GrantTable,
    ) -> "RelayContext":
        memory = RelayMemory.of(limits, table.quota_class)
        return cls(loop, limits, reporter, memory, Scratch(loop.pump), interceptor, table)
