"""What a host is to the shares: by the policy in force, and by what it has registered."""

import ipaddress

from appliance.channel.answers.recording_answers import APPLIANCE, ROBOT, UNKNOWN
from appliance.control.quota_class import HostStanding, charged_to
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import Standing

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


def test_recordings_are_charged_by_the_policys_names() -> None:
    """The robot's machine is the robot, hosts of one network are one, and so are all unknown hosts."""
    policy = compile_policy(
        "[Nodes]\n/a = robot 10.0.0.9 10.1.0.0/16\n",
        file="p.ini",
        robot=[ipaddress.ip_address("172.17.0.1")],
    )
    hosts = ("172.17.0.1", "127.0.0.1", "10.0.0.9", "10.1.2.3", "10.9.9.9", "")
    assert [charged_to(policy, host) for host in hosts] == [
        ROBOT,
        ROBOT,
        "10.0.0.9",
        "10.1.0.0/16",
        UNKNOWN,
        APPLIANCE,
    ]
