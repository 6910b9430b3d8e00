"""Parse the actions and hosts of test cases and commands, such as `publish /scan` or `host:ocu-1`."""

import ipaddress

from appliance.base.validation_messages import meant
from appliance.policy.commands import ALIASES, COMMANDS, DECIDED_ELSEWHERE
from appliance.policy.groups import ROBOT
from appliance.policy.host_names import HostNames, UnknownHostNameError
from appliance.policy.host_sets import Network, canonical_address
from appliance.policy.keys import is_parameter_key
from appliance.policy.model import Address, Category
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import quote
from appliance.policy.sections import PARAMETERS
from roswire.names import is_global_name

_MAX_NAMED = 3
VERBS = {"use-node" if category is Category.NODE else category.value: category for category in Category}


class BadWordError(ValueError):
    """A word is invalid; the message gives the reason and the remedy."""


def parse_action(text: str) -> tuple[Category, str]:
    verb, _, name = text.strip().partition(" ")
    category = VERBS.get(verb)
    if category is None:
        verbs = ", ".join(VERBS)
        raise BadWordError(f"{quote(text)} does not begin with a known verb; one of {verbs}")
    return category, check_resource(category, name.strip())


def check_resource(category: Category, name: str) -> str:
    """Return a resource. Raises `BadWordError` if a request of this category cannot have it."""
    if category is Category.COMMAND:
        if ALIASES.get(name, name) not in COMMANDS:
            elsewhere = DECIDED_ELSEWHERE.get(name)
            guess = f": it is decided by {elsewhere}" if elsewhere else meant(name, COMMANDS)
            raise BadWordError(f"{quote(name)} is not a command{guess}")
    elif not (is_parameter_key(name) if category in PARAMETERS else is_global_name(name)):
        raise BadWordError(f"{quote(name)} is not a resolved ROS name, such as /landshark/gps")
    return name


def find_hosts(text: str, policy: Policy) -> tuple[Address, ...]:
    """Return the addresses that a text names; for a group's network, its first host. Raises `BadWordError`."""
    try:
        return (canonical_address(ipaddress.ip_address(text)),)
    except ValueError:
        if "/" in text:
            raise BadWordError(f"{quote(text)} is not one host: give an address in it") from None
        names = HostNames.of(policy.text, policy.enrolled, policy.robot)
    try:
        return tuple(_first(network) for network in names.networks(text))
    except UnknownHostNameError as error:
        raise BadWordError(str(error)) from None


def find_host(text: str, policy: Policy) -> Address:
    """Return the address that a text names; for `robot`, the first one. Raises `BadWordError`, even for several."""
    found = find_hosts(text, policy)
    if len(found) > 1 and text != ROBOT:
        some = ", ".join(map(str, found[:_MAX_NAMED]))
        raise BadWordError(f"{quote(text)} is not one host: give the address, such as {some}")
    return found[0]


def _first(network: Network) -> Address:
    return network[1] if network.num_addresses > 2 else network[0]
