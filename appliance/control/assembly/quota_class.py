"""Find the quota class of a host, from the policy and the registry (`appliance/quotas`)."""

from collections.abc import Callable

from appliance.base.actors import APPLIANCE, ROBOT, UNKNOWN
from appliance.policy.host_sets import EVERYONE
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.quotas.pool import QuotaClass


class HostQuotaClass:
    """The quota class of hosts, by the policy in force and by their registrations.

    `policy()` returns the policy in force; `registrations(host)` returns the number of a host's registrations.
    """

    def __init__(self, policy: Callable[[], Policy], registrations: Callable[[Address], int]) -> None:
        self._policy = policy
        self._registrations = registrations

    def __call__(self, host: Address) -> QuotaClass:
        """Return the present quota class of a host. In audit-only mode, also an unknown host can have registrations."""
        # The policy need not name loopback, from which the appliance's own nodes call.
        if not (host.is_loopback or self._policy().standing(host).known):
            return QuotaClass.UNKNOWN
        return QuotaClass.REGISTERED if self._registrations(host) else QuotaClass.NAMED

    def of_text(self, host: str) -> QuotaClass:
        """Return the quota class of a host in an audit record. A text that is not an address counts as named."""
        try:
            return self(address_of(host))
        except ValueError:
            return QuotaClass.NAMED

    def has_reserve(self, host: str) -> bool:
        """Return whether the last part of the audit log's reserve is for this host: the robot, or one the policy names.

        A policy that names only `*` keeps it for hosts with a registration.
        """
        try:
            address = address_of(host)
        except ValueError:
            return False
        policy = self._policy()
        if address.is_loopback or any(address in network for network in policy.robot):
            return policy.blocked(address) is None
        if policy.named <= {EVERYONE}:
            return self(address) is QuotaClass.REGISTERED
        return policy.names(address)


def charged_to(policy: Policy, host: str) -> str:
    """Return the name to which a host's acts are charged."""
    try:
        address = address_of(host)
    except ValueError:
        return APPLIANCE
    if address.is_loopback or any(address in network for network in policy.robot):
        return ROBOT
    return policy.counted_as(address).removesuffix("/32").removesuffix("/128") or UNKNOWN
