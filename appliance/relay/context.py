"""What every part of one relay shares."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.relay.bounds import Limits
from appliance.relay.connections.frames import Scratch
from appliance.relay.connections.memory import Memory
from appliance.relay.loop import Loop
from appliance.relay.monitors.interceptor import Middle
from appliance.relay.report import Reporter


@dataclass(frozen=True, slots=True)
class RelayContext:
    """Loop, bounds, the voice to control, what hosts hold of the memory, where small frames come in, monitors."""

    loop: Loop
    limits: Limits
    reporter: Reporter
    memory: Memory
    scratch: Scratch
    middle: Middle
    payer: Callable[[str], str]
    """Who pays for the processor time of a host now."""
