"""What every part of one relay shares."""

from dataclasses import dataclass

from appliance.relay.frames import MemoryBudget
from appliance.relay.limits import Limits
from appliance.relay.loop import Loop
from appliance.relay.memory import HostShares
from appliance.relay.middle import Middle
from appliance.relay.report import Reporter


@dataclass(frozen=True, slots=True)
class RelayContext:
    """Loop, bounds, the voice to control, the memory in use, the area small frames are received into, monitors.

    `shares` are those of each host in the memory, `headers` in that for headers of peers that nobody knows yet.
    """

    loop: Loop
    limits: Limits
    reporter: Reporter
    budget: MemoryBudget
    scratch: memoryview
    middle: Middle
    shares: HostShares
    headers: HostShares
