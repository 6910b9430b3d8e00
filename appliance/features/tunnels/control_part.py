"""Build the part of control for hosts in tunnels: enrolment, certificates, and the checks of ports."""

from functools import partial

from appliance.control.assembly.assembly import Parts
from appliance.control.assembly.foundation import Foundation
from appliance.control.operators.request_method import RequestMethod
from appliance.features.feature import FeaturePart
from appliance.features.tunnels import host_requests
from appliance.features.tunnels.certification import Certification
from appliance.features.tunnels.enrolment import HostEnrolment, find_endpoint
from appliance.features.tunnels.rest_address import rest_address


def machines(base: Foundation, parts: Parts) -> dict[str, int]:
    """Return the number of live nodes by address, without nodes of doors, which run on the appliance."""
    doors = {str(address) for address in base.features.addresses().values()}
    nodes = parts.core.registry.machines()
    return {address: number for address, number in nodes.items() if address not in doors}


async def inherit(base: Foundation, parts: Parts) -> FeaturePart:
    settings = base.settings
    certification = Certification(
        base.store,
        base.trail,
        base.host_authority.authority,
        base.table,
        base.tunnels,
        appliances=base.host_authority.appliances,
        master_port=settings.listen_address[1],
        rest=rest_address(settings),
        ends=base.ends,
        changed=base.policies.hosts_changed,
    )
    hosts = HostEnrolment(
        certification,
        partial(find_endpoint, settings, base.lifeline.endpoint),
        expel=parts.endpoints.enforcement.expel,
        carried_out=parts.endpoints.relay.carried_out,
        machines=partial(machines, base, parts),
        in_words=base.policies.in_words,
    )
    return FeaturePart(
        methods=(
            RequestMethod(host_requests.HostList, hosts.listed),
            RequestMethod(host_requests.HostEndpoint, hosts.endpoint),
            RequestMethod(host_requests.HostKit, hosts.kit),
            RequestMethod(host_requests.HostAdd, hosts.add, who=True),
            RequestMethod(host_requests.HostRenew, hosts.renew, who=True),
            RequestMethod(host_requests.HostToken, hosts.token, who=True),
            RequestMethod(host_requests.HostRevoke, hosts.revoke, who=True, full_disk=True),
            RequestMethod(host_requests.HostsReload, hosts.reload, who=True),
            RequestMethod(host_requests.HostEnrol, hosts.itself.enrol),
            RequestMethod(host_requests.HostRenewItself, hosts.itself.renew),
            RequestMethod(host_requests.HostRenewed, hosts.itself.renewed),
            RequestMethod(host_requests.HostPorts, hosts.ports.tell, who=True),
            RequestMethod(host_requests.RevocationsWanted, certification.revocations),
            RequestMethod(host_requests.AuthorityWanted, certification.authority),
        ),
        hosts=hosts,
        work={"the tunnels": partial(base.tunnels.run, certification.each_hour)},
    )
