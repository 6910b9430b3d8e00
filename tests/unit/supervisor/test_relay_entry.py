"""Tests of `appliance.supervisor.relay_entry`."""

from dataclasses import fields

from appliance.config import Relay, Settings
from appliance.relay.limits import Limits
from appliance.supervisor.relay_entry import limits_of


def test_every_key_reaches_the_relay() -> None:
    """Each key of the section `relay` is a limit of the relay, with the same default, and changes it."""
    keys = {field.name for field in fields(Relay)}
    assert keys <= {field.name for field in fields(Limits)}
    assert limits_of(Settings()) == Limits()
    for name in keys:
        changed = Settings(relay=Relay(**{name: 7 << 20}))
        assert getattr(limits_of(changed), name) == 7 << 20
