"""What the routes work with, named once."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

from appliance.api.access import Doorkeeper
from appliance.api.control import ControlLink
from appliance.api.history import History
from appliance.api.journal import Journal
from appliance.api.streams import Streams
from appliance.configuration.settings import Settings
from appliance.quotas.table import REST_EXPORTS


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that the routes share; `stopping` is set when the process is to end.

    `judging` bounds the texts that are compiled at once to answer questions and dry runs, `ordering` those of orders,
    which never wait for the others; `exports` bounds the exports of the audit log.
    """

    settings: Settings
    control: ControlLink
    doorkeeper: Doorkeeper
    journal: Journal
    stopping: asyncio.Event
    history: History
    judging: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(2))
    ordering: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(2))
    exports: Streams = field(
        default_factory=lambda: Streams(REST_EXPORTS, REST_EXPORTS, REST_EXPORTS.bounds.whole)
    )

    @property
    def audit_log(self) -> Path:
        """The audit log, which may be read here and not written."""
        return self.settings.state / "control" / "audit.db"
