from typing import Any

import pytest
import yaml

from appliance.configuration.config_sources import read, resolve
from appliance.configuration.settings import Settings
from appliance.features.tunnels.certification import rest_address
from tests.unit.test_container_files import ROOT, environment

NET = ["192.168.1.0/24"]


@pytest.mark.parametrize(
    ("settings", "trouble"),
    [
        ({"api": "off", "isolation": "netns"}, "REST is off"),
        ({"api": "127.0.0.1:8443", "api_tls": False, "isolation": "container"}, "clear text"),
        ({"isolation": "none", "api_networks": NET}, "no tunnels"),
        ({"api": "127.0.0.1:8443", "isolation": "container", "api_networks": NET}, "api: 0.0.0.0:8443"),
        ({"api": "0.0.0.0:8443", "isolation": "container"}, "api_networks"),
        ({"api": "127.0.0.1:8443", "isolation": "netns"}, "api_networks"),
        (
            {"api": "0.0.0.0:8443", "isolation": "container", "api_networks": NET, "api_published": False},
            "publish port 8443 of the container on an address of this machine",
        ),
    ],
)
def test_an_unreachable_rest_says_which_setting_helps(settings: dict[str, Any], trouble: str) -> None:
    address = rest_address(read(settings))
    assert address.port is None
    assert trouble in address.trouble


@pytest.mark.parametrize(
    ("settings", "port", "inner"),
    [
        ({"api": "0.0.0.0:8443", "isolation": "container", "api_networks": NET}, 8443, 8443),
        ({"api": "10.1.2.3:8443", "isolation": "container", "api_networks": NET}, 8443, None),
        ({"api": "127.0.0.1:9000", "isolation": "netns", "api_networks": NET}, 9000, 9000),
    ],
)
def test_the_address_where_hosts_reach_rest(settings: dict[str, Any], port: int, inner: int | None) -> None:
    address = rest_address(read(settings))
    assert (address.port, address.trouble, address.inner_port) == (port, "", inner)


def test_in_a_namespace_hosts_renew_without_any_setting() -> None:
    assert rest_address(Settings(isolation="netns")).inner_port == 8443


def test_tunnels_reach_an_unpublished_port() -> None:
    settings = {"api": "0.0.0.0:8443", "isolation": "container", "api_networks": NET, "api_published": False}
    assert rest_address(read(settings)).inner_port == 8443


def test_no_script_is_written_that_cannot_reach_rest() -> None:
    published = [
        port
        for port in yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["appliance"]["ports"]
        if port.endswith(":8443")
    ]
    assert published == ["127.0.0.1:8443:8443"]
    listens = {"ROSRV_API": "0.0.0.0:8443", "ROSRV_ISOLATION": "container"}  # as in the Dockerfile
    address = rest_address(resolve(None, listens | environment(), {}))
    assert address.port is None
    assert "ROSRV_API_PUBLISHED" in address.trouble
    override = {"ROSRV_API_PUBLISHED": "true", "ROSRV_API_NETWORKS": "[172.29.76.1/32, 192.168.1.0/24]"}
    assert rest_address(resolve(None, listens | environment() | override, {})).port == 8443
