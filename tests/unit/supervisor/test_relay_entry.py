import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from appliance.configuration.config_sources import plain
from appliance.configuration.settings import Relay, Settings
from appliance.relay.relay_limits import RelayLimits
from appliance.supervisor.relay_entry import limits_of


def test_every_key_reaches_the_relay(tmp_path: Path) -> None:
    written = tmp_path / "config.json"
    keys = {field.name for field in fields(Relay)}
    assert keys <= {field.name for field in fields(RelayLimits)}
    written.write_text(json.dumps(plain(Settings())))
    assert limits_of(written) == RelayLimits()
    for name in keys:
        value: Any = "/dev/other" if getattr(Relay(), name) == "" else 7 << 20
        written.write_text(json.dumps(plain(Settings(relay=Relay(**{name: value})))))
        assert getattr(limits_of(written), name) == value
