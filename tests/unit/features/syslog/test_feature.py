import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from appliance.configuration.config_sources import ConfigError, read, resolve
from appliance.configuration.sections import Sections
from appliance.features.syslog.feature import FEATURE
from appliance.features.syslog.settings import Syslog
from appliance.supervisor.roles import ROLES, roles_of


@pytest.mark.parametrize(
    ("text", "destination"),
    [
        ("udp://10.0.0.9:514", ("udp", "10.0.0.9", 514)),
        ("tcp://[fd00::9]:601", ("tcp", "fd00::9", 601)),
        ("tls://10.0.0.9:6514", ("tls", "10.0.0.9", 6514)),
    ],
)
def test_a_syslog_receiver(text: str, destination: tuple[str, str, int]) -> None:
    settings = read({"audit": {"syslog": {"to": text}}})
    assert settings.of(Syslog).destination == destination


@pytest.mark.parametrize(
    ("syslog", "why"),
    [
        ({"to": "10.0.0.9:514"}, "is not udp://"),
        ({"to": "http://10.0.0.9:514"}, "is not udp://"),
        ({"to": "tls://logs.example.com:6514"}, "names are not looked up"),
        ({"to": "udp://10.0.0.9:0"}, "port 0"),
        ({"to": "udp://127.0.0.1:514"}, "loopback of the appliance's own namespace"),
        ({"to": "tcp://10.0.0.9:601", "ca": "x.pem"}, "ca would have no effect"),
        ({"name": "logs"}, "name would have no effect"),
        ({"to": "tls://10.0.0.9:6514", "key": "x.pem"}, "must be given together"),
        ({"to": "udp://10.0.0.9:514", "facility": 24}, "facility"),
    ],
)
def test_an_invalid_syslog_receiver_is_rejected(syslog: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        read({"audit": {"syslog": syslog}})


def test_the_forwarder_runs_only_if_configured() -> None:
    (forwarder,) = FEATURE.roles
    wanted = Sections({Syslog: Syslog(to="tls://10.0.0.9:6514")})
    assert forwarder in roles_of(sections=wanted)
    assert forwarder not in roles_of()
    assert forwarder.user not in {role.user for role in ROLES if role is not forwarder}
    assert forwarder.group == "rosrv-api"
    assert forwarder.dispensable
    assert not forwarder.capabilities
    assert forwarder.receiver(wanted) == ("audit log's forwarder", "tls", "10.0.0.9", 6514)


def test_a_section_in_the_wrong_place_names_the_right_one(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text("syslog: {}\n")  # `sso` is similar
    with pytest.raises(ConfigError, match=re.escape("unknown key syslog: did you mean audit.syslog?")):
        resolve(file, {}, {})
