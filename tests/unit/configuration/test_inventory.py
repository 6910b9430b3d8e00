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
    inventory.inventory.cache_clear()
    yield
    inventory.inventory.cache_clear()


def test_on_debian_it_lists_needed_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "status").write_text(STATUS)
    monkeypatch.setattr(inventory, "DPKG", tmp_path)
    found = [(part.name, part.version) for part in inventory.inventory().parts if part.kind == "debian"]
    assert found == [("nftables", "1.0.6-2+deb12u2")]


def test_elsewhere_it_lists_python_packages_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inventory, "DPKG", tmp_path)
    found = inventory.inventory()
    assert {part.kind for part in found.parts} == {"python"}
    (own,) = [part for part in found.parts if part.name == "rosrv-appliance"]
    assert (own.version, own.licences) == (__version__, ["Apache-2.0"])


def test_a_build_has_its_commit_and_the_hash_of_its_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_licences_of_debian_packages(text: str, licences: list[str]) -> None:
    assert inventory.debian_licences(text) == licences
