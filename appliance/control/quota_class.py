"""What the policy and the registry know of a host: which share of a finite thing is its own (`appliance/quotas`)."""

from collections.abc import Callable

from appliance.channel.answers.recording_answers import APPLIANCE, ROBOT, UNKNOWN
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy
from appliance.quotas.pool import Standing


class HostStanding:
    """The standing of hosts, by the policy in force at that moment and by what is registered.

    `policy()` is the one in force; `registrations(host)` is how many registrations a host has.
    """

    def __init__(self, policy: Callable[[], Policy], registrations: Callable[[Address], int]) -> None:
        self._policy = policy
        self._registrations = registrations

    def __call__(self, host: Address) -> Standing:
        """The standing of this host now."""
        if self._registrations(host):
            return Standing.REGISTERED
        # The policy need not name the appliance itself, whose own nodes call from loopback.
        if host.is_loopback or self._policy().knows(host):
            return Standing.NAMED
        return Standing.STRANGER

    def of_text(self, host: str) -> Standing:
        """The same of a host as records have it; what is no address is nobody's that could be a stranger."""
        try:
            return self(address_of(host))
        except ValueError:
            return Standing.NAMED


def charged_to(policy: Policy, host: str) -> str:
    """By what name recordings of a host's acts are charged: see `recorder.plan`."""
    try:
        address = address_of(host)
    except ValueError:
        return APPLIANCE
    if address.is_loopback or any(address in network for network in policy.robot):
        return ROBOT
    return policy.counted_as(address).removesuffix("/32").removesuffix("/128") or UNKNOWN
