"""Build the part of control for hosts in tunnels: enrolment, certificates, and the checks of ports."""

from functools import partial

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.tunnels import requests
from appliance.features.tunnels.certification import Certification, rest_address
from appliance.features.tunnels.enrolment import HostEnrolment, find_endpoint


def machines(core: Core) -> dict[str, int]:
    """Return the number of live nodes by address, without nodes of doors, which run on the appliance."""
    doors = {str(address) for address in core.policy.hosts().values()}
    return {address: number for address, number in core.graph.machines().items() if address not in doors}


async def begin(core: Core) -> ControlPart:
    settings = core.settings
    certification = Certification(
        core.store,
        core.trail,
        core.hosts.authority.authority,
        core.hosts.table,
        core.hosts.tunnels,
        appliances=core.hosts.authority.appliances,
        master_port=settings.listen_address[1],
        rest=rest_address(settings),
        ends=core.ends,
        changed=core.policy.hosts_changed,
    )
    hosts = HostEnrolment(
        certification,
        partial(find_endpoint, settings, core.links.endpoint),
        expel=core.graph.expel,
        carried_out=core.relay.carried_out,
        machines=partial(machines, core),
        in_words=core.policy.in_words,
    )
    core.hosts.provide(hosts)
    return ControlPart(
        (
            RequestMethod(requests.HostList, hosts.list_hosts),
            RequestMethod(requests.HostEndpoint, hosts.endpoint),
            RequestMethod(requests.HostKit, hosts.kit),
            RequestMethod(requests.HostAdd, hosts.add, who=True),
            RequestMethod(requests.HostRenew, hosts.renew, who=True),
            RequestMethod(requests.HostToken, hosts.token, who=True),
            RequestMethod(requests.HostRevoke, hosts.revoke, who=True, full_disk=True),
            RequestMethod(requests.HostsReload, hosts.reload, who=True),
            RequestMethod(requests.HostEnrol, hosts.itself.enrol),
            RequestMethod(requests.HostRenewItself, hosts.itself.renew),
            RequestMethod(requests.HostRenewed, hosts.itself.renewed),
            RequestMethod(requests.HostPorts, hosts.ports.tell, who=True),
            RequestMethod(requests.RevocationsWanted, certification.revocations),
            RequestMethod(requests.AuthorityWanted, certification.authority),
        ),
        {"the tunnels": partial(core.hosts.tunnels.run, certification.each_hour)},
    )
