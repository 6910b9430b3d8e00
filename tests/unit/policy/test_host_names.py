from ipaddress import ip_address, ip_network

import pytest

from appliance.policy.host_names import HostNames, UnknownHostNameError, label_of

TEXT = """
[Groups]
tablet = 10.77.0.66
guests = 10.77.0.0/24 visitor
visitor = host:laptop
all = *
[Nodes]
default = all
"""
NAMES = HostNames.of(
    TEXT,
    {
        "laptop": ip_address("10.113.0.5"),
        "tablet": ip_address("10.113.0.9"),
        "door:alice": ip_address("198.18.0.2"),
    },
    [ip_network("10.88.0.10/32")],
)


@pytest.mark.parametrize(
    ("text", "networks"),
    [
        ("10.0.0.1", "10.0.0.1/32"),
        ("::ffff:10.0.0.1", "10.0.0.1/32"),
        ("10.0.0.0/8", "10.0.0.0/8"),
        ("robot", "10.88.0.10/32"),
        ("guests", "10.77.0.0/24 10.113.0.5/32"),
        ("laptop", "10.113.0.5/32"),
        ("tablet", "10.77.0.66/32 10.113.0.9/32"),
        ("host:tablet", "10.113.0.9/32"),
        ("door:alice", "198.18.0.2/32"),
    ],
)
def test_a_name_means_all_its_networks(text: str, networks: str) -> None:
    assert " ".join(map(str, NAMES.networks(text))) == networks


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tabled", "did you mean .?tablet"),
        ("host:labtop", "laptop"),
        ("door:alicf", "no door .*alice"),
        ("nobody", "names are robot, tablet"),
        ("", "not an"),
    ],
)
def test_an_unknown_name_is_an_error(text: str, said: str) -> None:
    with pytest.raises(UnknownHostNameError, match=said):
        NAMES.networks(text)


@pytest.mark.parametrize(
    ("text", "host"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("robot", "10.88.0.10"),
        ("host:tablet", "10.113.0.9"),
    ],
)
def test_an_order_names_one_host(text: str, host: str) -> None:
    assert NAMES.host(text) == ip_address(host)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("10.77.0.0/24", "give one address"), ("all", "not one host: give one address (0.0.0.0/0"),
        ("tablet", "(10.77.0.66, 10.113.0.9)"), ("guests", "(10.77.0.0/24, 10.113.0.5)"), ("nobody", "names are"),
    ],
)  # fmt: skip
def test_an_order_for_a_network_or_for_several_hosts_is_an_error(text: str, said: str) -> None:
    """An address that a network merely begins with may be that of no host."""
    with pytest.raises(UnknownHostNameError) as refused:
        NAMES.host(text)
    assert said in str(refused.value)


def test_an_address_has_the_narrowest_label() -> None:
    labels = NAMES.labels()
    addresses = (
        "10.77.0.66",
        "10.77.0.3",
        "::ffff:10.113.0.5",
        "10.88.0.10",
        "10.113.0.9",
        "198.18.0.2",
        "192.0.2.1",
        "local",
    )
    assert [label_of(address, labels) for address in addresses] == [
        "tablet", "guests", "laptop", "robot", "tablet", "door:alice", "", "",
    ]  # fmt: skip
