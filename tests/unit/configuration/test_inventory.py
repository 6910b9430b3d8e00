"""Tests of `appliance.configuration.inventory`."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance import __version__
from appliance.configuration import inventory

STATUS = """\
Package: nftables
Status: install ok installed
Version: 1.0.6-2+deb12u2

Package: rosout
Status: deinstall ok config-files
Version: 1.15.15+ds-2

Package: vim
Status: install ok installed
Version: 9.0
"""


@pytest.fixture(autouse=True)
def anew() -> Iterator[None]:
    """It is gathered once in a process: here for each test."""
    inventory.inventory.cache_clear()
    yield
    inventory.inventory.cache_clear()


def test_of_debian_it_names_what_the_appliance_stands_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Installed packages that it needs; neither those of others nor what was removed."""
    (tmp_path / "status").write_text(STATUS)
    monkeypatch.setattr(inventory, "DPKG", tmp_path)
    found = [(part.name, part.version) for part in inventory.inventory().parts if part.kind == "debian"]
    assert found == [("nftables", "1.0.6-2+deb12u2")]


def test_elsewhere_than_on_debian_there_are_pythons_parts_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without dpkg's list nothing is made up."""
    monkeypatch.setattr(inventory, "DPKG", tmp_path)
    found = inventory.inventory()
    assert {part.kind for part in found.parts} == {"python"}
    (own,) = [part for part in found.parts if part.name == "rosrv-appliance"]
    assert (own.version, own.licences) == (__version__, ["Apache-2.0"])


def test_a_build_says_its_commit_and_the_hash_of_its_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an image has them; a checkout has neither."""
    assert (inventory.inventory().build, inventory.inventory().parts_list) == (None, None)
    inventory.inventory.cache_clear()
    monkeypatch.setattr(inventory, "SHIPPED", tmp_path)
    (tmp_path / "build.json").write_text(json.dumps({"kind": "image", "commit": "c0ffee"}))
    (tmp_path / "sbom.cdx.json").write_text("{}")
    found = inventory.inventory()
    assert found.build == {"kind": "image", "commit": "c0ffee"}
    assert found.parts_list == hashlib.sha256(b"{}").hexdigest()


@pytest.mark.parametrize(
    ("text", "licences"),
    [
        ("Format: https://…\nLicense: MIT\n\nLicense: GPL-2+\n text\nLicense: MIT\n", ["GPL-2+", "MIT"]),
        ("It is in /usr/share/common-licenses/GPL-2.\n", ["GPL-2"]),
        ("", []),
    ],
)
def test_debians_licences(text: str, licences: list[str]) -> None:
    """In Debian's own format, in words that name the common ones, or not said."""
    assert inventory.debian_licences(text) == licences
