"""Let control of one of two appliances serve only in an epoch of the lease, with the state of the other one."""

import asyncio
from pathlib import Path

from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import ActiveRole
from appliance.control.control import Control
from appliance.control.core import ControlPart
from appliance.control.errors import StateError
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.control.start_gate import StartGate
from appliance.features.standby.lease_client import LeaseClient
from appliance.features.standby.lease_link import LeaseLink
from appliance.features.standby.membership import LINK_FILE, MembershipError, load_membership
from appliance.features.standby.paired_role import PairedRole
from appliance.features.standby.passive import until_activated
from appliance.features.standby.service_begin import begin
from appliance.specifications.compiler_link import SpecificationCompiler


class StandbyGate(StartGate):
    """Stands by until the lease is held. A single appliance serves at once."""

    def __init__(self) -> None:
        self._lease = LeaseClient()
        self.links = {"lease": (self._lease.attach, LeaseLink)}

    async def role(
        self,
        config: Path,
        settings: Settings,
        lifeline: ControlLifeline,
        compiler: SpecificationCompiler,
        stopping: asyncio.Event,
    ) -> ActiveRole | None:
        try:
            membership = load_membership(config.with_name(LINK_FILE))
        except MembershipError as error:
            raise StateError(str(error)) from error
        if membership is None:
            return ActiveRole()
        pair = await until_activated(membership, settings, lifeline, self._lease, compiler, stopping=stopping)
        return None if pair is None else PairedRole(pair, settings)

    async def begin(self, control: Control) -> ControlPart:
        return await begin(control)


GATE = StandbyGate
