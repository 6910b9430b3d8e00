"""Tests of reading `ipsec/hosts.yaml`."""

from pathlib import Path

import pytest

from appliance.master.declared import DeclaredHost, DeclaredHostsError, read_declared


def test_hosts_with_and_without_an_address(tmp_path: Path) -> None:
    """Each host is there by its name, with the address kept for it."""
    path = tmp_path / "hosts.yaml"
    path.write_text("hosts:\n  - name: ocu-1\n    address: 10.113.11.20\n  - name: laptop\n")
    assert read_declared(path) == {
        "ocu-1": DeclaredHost("ocu-1", "10.113.11.20"),
        "laptop": DeclaredHost("laptop", None),
    }


def test_no_file_and_an_empty_one_declare_nobody(tmp_path: Path) -> None:
    """The baseline may be missing."""
    assert read_declared(tmp_path / "none.yaml") == {}
    (tmp_path / "empty.yaml").write_text("# nobody yet\n")
    assert read_declared(tmp_path / "empty.yaml") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("hosts: [", "cannot be read"),
        ("hosts:\n  - name: 'a b'\n", "hosts.0.name"),
        ("hosts:\n  - name: a\n    address: 10.0.0\n", "hosts.0.address"),
        ("hosts:\n  - name: a\n    group: b\n", "hosts.0.group"),
        ("hosts:\n  - name: a\n  - name: a\n", "declared twice"),
        ("- a\n", "the file"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, said: str) -> None:
    """The message says which file and where in it."""
    path = tmp_path / "hosts.yaml"
    path.write_text(text)
    with pytest.raises(DeclaredHostsError, match=r"hosts\.yaml") as error:
        read_declared(path)
    assert said in str(error.value)
