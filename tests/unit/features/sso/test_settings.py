from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from appliance.features.sso.errors import ProviderError
from appliance.features.sso.provider_connection import ProviderConnection
from appliance.features.sso.settings import Sso
from tests.unit.configuration.test_config_sources import mistakes
from tests.unit.features.sso.scripted_provider import sso

GOOD: dict[str, Any] = {
    "issuer": "https://id.example.org/plant", "address": "10.0.0.5:443", "client_id": "rosrv",
    "url": "https://robot.example.org:8443", "roles": {"viewer": ["staff"]},
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"issuer": None}, "the section has no effect without an issuer"),
        ({"issuer": "http://id.example.org"}, "is not https: use https://"),
        ({"issuer": "https://id.example.org?a=1"}, "has a query"),
        ({"issuer": "https://u:p@id.example.org"}, "no user, fragment or space"),
        ({"client_id": ""}, "client_id must be given with issuer"),
        ({"roles": {}}, "roles must be given with issuer"),
        ({"roles": {"boss": ["staff"]}}, "viewer"),
        ({"roles": {"viewer": []}}, "at least 1 item"),
        ({"roles": {"viewer": [""]}}, "at least 1 character"),
        ({"url": "https://robot.example.org:8443/console"}, "without a path"),
        ({"url": "http://robot.example.org"}, "is not https"),
        ({"address": "id.example.org:443"}, "is not an address; names are not looked up"),
        ({"address": None}, "either address"),
        ({"proxy": "http://10.0.0.3:3128"}, "either address"),
        ({"address": None, "proxy": "https://10.0.0.3:3128"}, "is not http://ADDRESS:PORT"),
        ({"scopes": ["profile"]}, "scopes must contain openid"),
        ({"algorithms": ["none"]}, "RS256"),
        ({"algorithms": ["HS256"]}, "RS256"),
        ({"algorithms": []}, "at least 1 item"),
        ({"domains": ["@Example.org"]}, "is not a domain in lower case"),
        ({"doors": {"a b": ["x"]}}, "is not a name of a door group"),
        ({"clock_skew_seconds": 301}, "less than or equal to 300"),
        ({"session_hours": 0}, "greater than 0"),
        ({"default_role": "viewer"}, "nexpected"),
    ],
    ids=lambda value: str(value)[:60],
)
def test_a_wrong_setting_is_refused_with_its_reason(change: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(Sso).validate_python(GOOD | change)
    assert reason in str(refused.value)


def test_a_wrong_key_of_a_mapping_is_named_with_the_valid_ones(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text("sso:\n  roles:\n    operators: [x]\n")
    (found,) = mistakes(file)
    assert found.startswith(f"{file}:3: sso.roles: the key 'operators': must be 'viewer', ")
    assert "[key]" not in found


def test_the_firewall_lets_the_process_reach_the_provider_or_the_proxy_only() -> None:
    assert TypeAdapter(Sso).validate_python(GOOD).destination == ("10.0.0.5", 443)
    through = sso(address=None, proxy="http://10.0.0.3:3128")
    assert (through.destination, through.receivers()) == (
        ("10.0.0.3", 3128),
        {"proxy": (through.proxy, "10.0.0.3")},
    )


@pytest.mark.anyio
@pytest.mark.parametrize(
    "url", ["https://evil.example.org/keys", "https://id.example.org:444/", "http://10.0.0.5/"]
)
async def test_without_a_proxy_only_the_issuers_host_is_asked(url: str) -> None:
    with pytest.raises(ProviderError):
        await ProviderConnection(sso()).exchange("GET", url)


def test_a_start_records_who_gets_which_role_and_no_secret(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_text("the client's secret")
    recorded = sso(client_secret_file=file, roles={"admin": ["it"]}).audit_values()
    assert recorded["roles"] == "{'admin': ['it']}" and recorded["client_secret_file"] == str(file)
    assert "the client's secret" not in str(recorded)
    assert Sso().audit_values() == {}
