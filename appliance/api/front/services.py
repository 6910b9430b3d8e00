"""Define the parts that the routes share."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.control import ControlLink
from appliance.api.front.history import SampleHistory
from appliance.api.front.journal import Journal
from appliance.api.front.streams import Streams, Work
from appliance.configuration.settings import Settings
from appliance.quotas.table import REST_EXPORTS, REST_WORK

_SEARCHES = 4


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that all routes use.

    `judging` queues the compilations of queries and dry runs, fairly by token. Orders have `ordering` instead, so they
    never wait for queries.
    """

    settings: Settings
    control: ControlLink
    doorkeeper: TokenAuthenticator
    journal: Journal
    stopping: asyncio.Event
    history: SampleHistory
    judging: Work = field(default_factory=lambda: Work("dry runs and explanations", REST_WORK.bounds.whole))
    searches: Work = field(default_factory=lambda: Work("searches of the audit log", _SEARCHES))
    ordering: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(2))
    exports: Streams = field(default_factory=lambda: Streams(REST_EXPORTS, REST_EXPORTS.bounds.whole))

    @property
    def audit_log(self) -> Path:
        return self.settings.state / "control" / "audit.db"
