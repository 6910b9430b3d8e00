"""Tests of `rosrv_fleet.config`: a wrong file is refused with its key and the reason."""

from pathlib import Path

import pytest
from rosrv_fleet.config import ConfigError, load_config

from tests.support.sources import ROOT


def test_the_example_is_valid() -> None:
    """The example has a valid configuration; paths are relative to its folder."""
    found = load_config(ROOT / "fleet/fleet.example.yaml")
    assert found.certificate == ROOT / "fleet/server.pem"
    assert found.address == ("0.0.0.0", 8444)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "Expected `object`"),
        ("certificate: a", "missing required field `key`"),
        ("certificate: a\nkey: b\nlisten: x", "listen|invalid literal"),
        ("certificate: a\nkey: b\nlisten: h:99999", "no valid port"),
        ("certificate: a\nkey: b\ntypo: 1", "typo"),
        ("certificate: a\nkey: b\nlimits: {uploads: 0}", "limits.uploads"),
        ("certificate: [a]\nkey: b", "path"),
        (":", "fleet.yaml"),
    ],
)
def test_a_wrong_configuration_is_refused(text: str, why: str, tmp_path: Path) -> None:
    """The error has the file and the reason."""
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=why) as error:
        load_config(file)
    assert str(file) in str(error.value)
