"""The role in which control serves. A feature's hook `may_start` can make control wait for it (`StartGate`).

A single appliance uses these classes and serves from its start to its end.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.configuration.settings import Settings
from appliance.control.assembly.host_authority import HostAuthority, make_host_authority
from appliance.control.assembly.policy_gate import PolicyRefusedError
from appliance.control.errors import StateError
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.features.feature import FeaturePart
from appliance.hosts.host_table import HostTable
from appliance.hosts.tunnel_state import Tunnels
from appliance.specifications.compiler_link import SpecificationCompiler
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

STATE_ERRORS = (StateError, PolicyRefusedError, SpecificationsRefusedError, StoreError, OSError)
"""The errors of a stored state or an own file that control cannot start with."""


class ActiveRole:
    """The right to serve, and its consequences.

    `paired`: another appliance can serve in place of this one, so it may have written the state. `name` is
    this appliance's name in its pair, `address` the address at which nodes reach the pair, and `robot` the
    robot's address. `took_over`: this process waited for the role. The link to the api (`api`), with the pin
    of its certificate, may already be open.
    """

    paired = False
    name = ""
    address: str | None = None
    robot: str | None = None
    took_over = False
    api: Channel | None = None
    pin = ""

    @property
    def before_answer(self) -> Callable[[], Awaitable[None]] | None:
        """Return the wait until all changes made so far may be answered; None: no answer waits."""
        return None

    def inherit(self, store: StateStore, age: Callable[[], int]) -> None:
        """Take over the state, before any part reads or changes it; `age()` is the age clock of this appliance."""

    def host_authority(
        self, signer: Link, store: StateStore, trail: AuditTrail, table: HostTable
    ) -> HostAuthority:
        """Return the authority of hosts' certificates, and the appliances at which hosts open their tunnels."""
        return make_host_authority(signer, store, trail, table)

    def hand_tunnels_to(self, tunnels: Tunnels) -> None:
        """Give a link that is already open to the tunnels."""

    def in_doubt(self) -> bool:
        """Return whether computers of the robot may refuse the connections of this appliance now."""
        return False

    def on_end_of_gap(self, ended: Callable[[], None]) -> None:
        """Call `ended` when computers of the robot stop refusing connections."""

    def close(self) -> None:
        """End the role: a change that is not answered yet gets no answer."""


class StartGate:
    """The decision when control may serve. `links` are control's ends of links that are needed for it."""

    links: Mapping[str, tuple[Callable[[Channel], None], Any]] = {}

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

    async def begin(self, base: Any, parts: Any) -> FeaturePart | None:
        """Return a part of control, once control has its other parts (`Foundation`, `Parts`) and before it serves."""
        del base, parts
        return None
