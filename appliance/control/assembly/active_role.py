"""The role in which control serves. A single appliance serves from its start to its end."""

from collections.abc import Awaitable, Callable
from pathlib import Path

from appliance.base.age_clock import AgeClock
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.control.assembly.hosts import HostAuthority, make_host_authority
from appliance.control.errors import PolicyRefusedError, StateError
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

STATE_ERRORS = (StateError, PolicyRefusedError, SpecificationsRefusedError, StoreError, OSError)
"""The errors of the stored state, or of one of the appliance's files, with which control cannot start."""


class ActiveRole:
    """The right to serve, and its consequences.

    `paired`: another appliance can serve in place of this one, so it may have written the state. `took_over`: this
    process waited for the role, `away_seconds` after it last followed the other appliance. `ports`: the TCP ports that
    exist at `address`, or None for all.
    """

    paired = False
    name = ""
    address: str | None = None
    ports: tuple[range, ...] | None = None
    robot: str | None = None
    took_over = False
    away_seconds: float | None = None
    api: Channel | None = None
    pin = ""

    @property
    def before_answer(self) -> Callable[[], Awaitable[None]] | None:
        """Return the wait until changes may be answered, or None if answers need not wait."""
        return None

    def inherit(self, store: StateStore) -> None:
        """Take over the state, before any part reads or changes it."""

    def ends(self, store: StateStore, age: Path) -> EndTable:
        """Return the ends by the clock with the file `age`. Call it after `inherit`."""
        return EndTable(store, AgeClock(age), appliance=self.name, away_seconds=self.away_seconds)

    def host_authority(
        self, signer: Link, store: StateStore, trail: AuditTrail, table: HostTable
    ) -> HostAuthority:
        return make_host_authority(signer, store, trail, table)

    def hand_tunnels_to(self, tunnels: Tunnels) -> None:
        """Give the tunnels a link that is already open."""

    def in_doubt(self) -> bool:
        return False

    def on_end_of_gap(self, ended: Callable[[], None]) -> None:
        """Call `ended` when the robot's computers no longer refuse connections."""

    def close(self) -> None:
        """End the role; a change that is not answered yet gets no answer."""
