"""The core for tests: real parts, of which only the disk and the clock are replaced.

`Core` has a real registry, state, ends and trail, in the test's virtual time. There is no double of the trail:
`FakeTrail` is the real one, on a log in memory.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.budget import Budget
from appliance.audit.log.ids import IdSource
from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord
from appliance.base.age_clock import AgeClock
from appliance.master.graph.registry import Registry
from appliance.quotas.pool import QuotaClass
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.engines import InlineDatabase


class MemoryLog(AuditLog):
    """An audit log whose records stay in memory. `failure` is the reason why it cannot be written."""

    def __init__(self, note: Callable[[AuditRecord], None], on_disk: Callable[[], None]) -> None:
        self._note, self._on_disk = note, on_disk
        self.path = Path("audit.db")
        self.ids = IdSource()
        self.budget = Budget(lambda _host: QuotaClass.NAMED)
        self.records: list[AuditRecord] = []
        self.failure: str | None = None

    @property
    def failed(self) -> str | None:
        return self.failure

    def record(self, record: AuditRecord) -> str:
        self.records.append(record)
        self._note(record)
        return record.id

    async def wait_durable(self) -> str | None:
        self._on_disk()
        return self.failure


class FakeTrail(AuditTrail):
    """The trail of control on a log in memory.

    `note` gets each record when it is made; `on_disk` is called at each wait for all records to be written.
    """

    def __init__(
        self,
        note: Callable[[AuditRecord], None] = lambda _record: None,
        on_disk: Callable[[], None] = lambda: None,
    ) -> None:
        self.log = MemoryLog(note, on_disk)
        super().__init__(self.log, strict=False, deny_when_failed=True)

    @property
    def records(self) -> list[AuditRecord]:
        return self.log.records

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return the fields of each record, with its details among them."""
        return [
            {**msgspec.structs.asdict(record), "detail": None, **record.detail} for record in self.records
        ]

    @property
    def events(self) -> list[str]:
        return [record.event for record in self.records]


class Core:
    """The parts that most of control needs. `restart` opens the state again, as a new process does."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.trail = FakeTrail()
        self.registry = Registry()
        self.restart()

    def restart(self) -> None:
        self.store = StateStore(self.folder, failed=pytest.fail, kind=InlineDatabase)
        self.ends = EndTable(self.store, AgeClock(self.folder / "age"))
