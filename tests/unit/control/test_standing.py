"""What a host is to the shares: by the policy in force, and by what it has registered."""

import ipaddress

from appliance.control.standing import HostStanding
from appliance.policy.compiler import compile_policy
from appliance.shares.pool import Standing

NAMED, OTHER = ipaddress.ip_address("10.0.0.1"), ipaddress.ip_address("10.0.0.2")


def test_standing_follows_reloads_and_registrations() -> None:
    """A rule that names the address, then a registration, raise a host; without them it is a stranger again."""
    policies = [
        compile_policy("[Nodes]\n/a = 10.0.0.1\n", file="a.ini"),
        compile_policy("[Nodes]\n/a = 10.0.0.2\n", file="b.ini"),
    ]
    registered = dict[object, int]()
    standing = HostStanding(lambda: policies[0], lambda host: registered.get(host, 0))
    assert (standing(NAMED), standing(OTHER)) == (Standing.NAMED, Standing.STRANGER)
    registered[OTHER] = 1
    assert standing(OTHER) is Standing.REGISTERED
    registered.clear()
    policies.reverse()
    assert (standing(NAMED), standing(OTHER)) == (Standing.STRANGER, Standing.NAMED)
    assert standing(ipaddress.ip_address("127.0.0.1")) is Standing.NAMED
