"""What the routes work with, named once."""

import asyncio
from dataclasses import dataclass
from pathlib import Path

from appliance.api.access import Doorkeeper
from appliance.api.control import ControlLink
from appliance.config import Settings


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that the routes share; `stopping` is set when the process is to end."""

    settings: Settings
    control: ControlLink
    doorkeeper: Doorkeeper
    stopping: asyncio.Event

    @property
    def audit_log(self) -> Path:
        """The audit log, which may be read here and not written."""
        return self.settings.state / "control" / "audit.db"
