"""Decide when control may serve. A single appliance serves at once; the feature with `gate.py` decides for a pair."""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from appliance.audit.log.log import AuditLog
from appliance.channel.channel import Channel
from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.core import ControlPart
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.master.parameter_mirror import ParameterMirror
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail


@dataclass(frozen=True, kw_only=True, slots=True)
class StartingControl:
    """The parts of a control that is about to serve."""

    settings: Settings
    role: ActiveRole
    store: StateStore
    trail: AuditTrail
    audit: AuditLog
    signed: asyncio.Event
    """Set with each signature of a checkpoint."""
    monitors: SpecificationManager
    parameters: ParameterMirror
    ready: asyncio.Event
    """Set once the ROS master has what the graph has."""
    relays: Callable[[], str]
    """Returns whether the relays are connected, as `RelayControl.presence`."""
    probe: Callable[[], str]
    """Returns the result of the probe of the ROS master's isolation."""
    overdue: Callable[[], float]
    """Returns the seconds for which a call has waited while none was answered."""


class StartGate:
    """Decides when control may serve."""

    links: Mapping[str, tuple[Callable[[Channel], None], object]] = {}

    async def role(
        self,
        config: Path,
        settings: Settings,
        lifeline: ControlLifeline,
        compiler: SpecificationCompiler,
        stopping: asyncio.Event,
    ) -> ActiveRole | None:
        """Wait until control may serve; return None if it is stopped first. Raises `STATE_ERRORS`."""
        del config, settings, lifeline, compiler, stopping
        return ActiveRole()

    async def begin(self, control: StartingControl) -> ControlPart | None:
        del control
        return None
