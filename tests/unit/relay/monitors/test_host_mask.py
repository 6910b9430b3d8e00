import pytest

from appliance.relay.monitors.interceptor import HostMask


@pytest.mark.parametrize(
    ("host", "hidden"),
    [
        ("10.0.0.7", True),
        ("10.8.3.4", True),
        ("10.0.0.8", False),
        ("fd00::7", False),
        ("an unknown host", True),
    ],
)
def test_hosts_of_withheld_networks_get_nothing_while_they_are_withheld(host: str, hidden: bool) -> None:
    """A host without an address could be any host."""
    networks: list[tuple[str, ...]] = [()]
    mask = HostMask(lambda: networks[0])
    assert not mask.hides(host)
    networks[0] = ("10.0.0.7/32", "10.8.0.0/16")
    assert mask.hides(host) is hidden
    networks[0] = ()
    assert not mask.hides(host)


def test_answers_about_many_hosts_stay_right() -> None:
    mask = HostMask(lambda: ("10.1.0.0/16",))
    hosts = [
        f"10.{second}.{third}.{fourth}" for second in (1, 2) for third in range(6) for fourth in range(200)
    ]
    assert [mask.hides(host) for host in hosts] == [host.startswith("10.1.") for host in hosts]
