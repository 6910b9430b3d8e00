from typing import Any

import pytest

from appliance.channel.messages import EndpointFound
from appliance.configuration.settings import Ipsec, Settings
from appliance.features.tunnels.enrolment import find_endpoint
from appliance.features.tunnels.tunnel_answers import Endpoint
from appliance.hosts.host_table import HostRefusedError
from tests.support import autojump


def _settings(endpoint: str | None = None, **more: Any) -> Settings:
    return Settings(ipsec=Ipsec(endpoint=endpoint), **more)


async def _found() -> EndpointFound:
    return EndpointFound("10.0.0.5", "the only address of this machine")


async def _several() -> EndpointFound:
    return EndpointFound(None, "this machine has several addresses (10.0.0.5, 10.0.1.5)")


def test_the_configured_endpoint_comes_first() -> None:
    assert autojump.run(find_endpoint(_settings("robot.example.org"), _several)) == Endpoint(
        "robot.example.org", "ipsec.endpoint of the configuration"
    )


def test_the_address_found_by_the_supervisor_comes_with_its_reason() -> None:
    assert autojump.run(find_endpoint(_settings(), _found)) == Endpoint(
        "10.0.0.5", "the only address of this machine"
    )


def test_an_unknown_endpoint_is_refused_with_advice() -> None:
    with pytest.raises(HostRefusedError) as caught:
        autojump.run(find_endpoint(_settings(), _several))
    for words in ("10.0.0.5, 10.0.1.5", "--appliance ADDRESS", "ipsec: {endpoint: ADDRESS}", "`endpoint`"):
        assert words in str(caught.value), words
    assert not caught.value.ours


@pytest.mark.parametrize("endpoint", [None, "10.0.0.5"])
def test_without_tunnels_no_endpoint_is_needed(endpoint: str | None) -> None:
    with pytest.raises(HostRefusedError, match="`isolation: netns` or `container`") as caught:
        autojump.run(find_endpoint(_settings(endpoint, isolation="none"), _found))
    assert "--appliance" not in str(caught.value)
