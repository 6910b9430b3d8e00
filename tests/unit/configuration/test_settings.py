import json
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from pydantic import ValidationError

from appliance.configuration.config_sources import plain, read
from appliance.configuration.sections import split_address
from appliance.configuration.settings import Settings, load_resolved


def test_every_key_has_a_default() -> None:
    settings = Settings()
    assert settings.listen_address == ("0.0.0.0", 11311)
    assert settings.limits.body_bytes == 16 * 1024 * 1024
    assert settings.limits.connections_per_host == 512
    assert settings.relay.queue_bytes == 64 * 1024 * 1024
    assert settings.audit.durability == "batched"


def test_children_read_the_supervisors_settings(tmp_path: Path) -> None:
    settings = read(
        {
            "listen": "[::1]:0",
            "advertise": [{"network": "10.0.0.0/8", "address": "10.0.0.1"}],
            "limits": {"body_bytes": "2MiB"},
            "audit": {"retention_days": 30},
        }
    )
    file = tmp_path / "config.json"
    file.write_text(json.dumps(plain(settings)))
    assert load_resolved(file) == settings
    assert load_resolved(file).limits.body_bytes == 2 * 1024 * 1024


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("0.0.0.0:11311", ("0.0.0.0", 11311)),
        ("[::]:11311", ("::", 11311)),
        ("robot-1.local:0", ("robot-1.local", 0)),
    ],
)
def test_an_address_is_host_and_port(text: str, address: tuple[str, int]) -> None:
    assert split_address(text) == address


@pytest.mark.parametrize(
    "text",
    [
        "11311",
        "host",
        "host:",
        ":1",
        "host:65536",
        "host:-1",
        "::1:11311",
        "[::1:1",
        "a b:1",
        "[x]:1",
        "h:\u0661",
    ],
)
def test_an_invalid_address_is_rejected(text: str) -> None:
    with pytest.raises(ValidationError):
        read({"listen": text})


@pytest.mark.parametrize("value", [0, -1, float("inf"), float("nan"), "soon"])
def test_a_time_is_a_positive_number(value: object) -> None:
    with pytest.raises(ValidationError):
        read({"limits": {"header_seconds": value}})


@pytest.mark.parametrize("api", ["0.0.0.0:8443", "[::]:8443", "10.0.0.2:8443", "robot:8443"])
def test_rest_in_clear_text_stays_on_this_machine(api: str) -> None:
    with pytest.raises(ValidationError, match="clear text"):
        read({"api": api, "api_tls": False})
    for here in ("127.0.0.1:1", "[::1]:1", "localhost:1", "127.9.9.9:1", "off"):
        assert read({"api": here, "api_tls": False}).api == here


def test_rest_can_be_disabled() -> None:
    assert read({"api": "off"}).api_address is None
    assert read({"api": False}).api_address is None
    assert Settings().api_address == ("127.0.0.1", 8443)


@pytest.mark.parametrize(
    ("pool", "said"),
    [
        ("fd00:77::/64", "virtual addresses are IPv4"),
        ("10.113.11.0/30", "prefix length from 16 to 29"),
        ("10.0.0.0/8", "prefix length from 16 to 29"),
    ],
)
def test_an_invalid_pool_of_virtual_addresses_is_rejected(pool: str, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        read({"ipsec": {"pool": pool}})


@pytest.mark.parametrize("endpoint", ["192.168.1.20", "fd00::20", "robot.example.org", "robot"])
def test_the_endpoint_is_an_address_or_a_name(endpoint: str) -> None:
    assert read({"ipsec": {"endpoint": endpoint}}).ipsec.endpoint == endpoint


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("192.168.1.20:500", "no port"),
        ("[fd00::20]", "no brackets"),
        ("192.168.1.300", "neither an address nor a name"),
        (" ", "neither an address nor a name"),
        ("a b", "neither an address nor a name"),
        ("127.0.0.1", "not an address at which other hosts"),
        ("0.0.0.0", "not an address at which other hosts"),
        ("fe80::1", "not an address at which other hosts"),
        ("localhost", "this machine only"),
    ],
)
def test_an_unreachable_endpoint_is_rejected(endpoint: str, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        read({"ipsec": {"endpoint": endpoint}})


def test_an_empty_endpoint_is_unset() -> None:
    assert read({"ipsec": {"endpoint": ""}}).ipsec.endpoint is None


def test_rules_of_annotated_keys_are_enforced() -> None:
    """pydantic ignores a rule that is beside the annotation of an annotated type."""

    def sections(section: Any) -> Iterator[Any]:
        yield section
        for kind in get_type_hints(section).values():
            if isinstance(kind, type) and is_dataclass(kind):
                yield from sections(kind)

    for section in sections(Settings):
        kinds = get_type_hints(section, include_extras=True)
        for field in fields(section):
            rules = set(field.metadata) - {"description", "json_schema_extra"}
            assert not rules or not hasattr(kinds[field.name], "__metadata__"), field.name
