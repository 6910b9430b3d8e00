from pathlib import Path

import pytest

from appliance.hosts.hosts_file import DeclaredHost, DeclaredHosts, DeclaredHostsError, read_declared


def test_hosts_with_and_without_an_address(tmp_path: Path) -> None:
    path = tmp_path / "hosts.yaml"
    path.write_text("hosts:\n  - name: ocu-1\n    address: 10.113.11.20\n  - name: laptop\n")
    assert read_declared(path) == {
        "ocu-1": DeclaredHost("ocu-1", "10.113.11.20"),
        "laptop": DeclaredHost("laptop", None),
    }


def test_a_missing_or_empty_file_declares_no_host(tmp_path: Path) -> None:
    assert read_declared(tmp_path / "none.yaml") == {}
    (tmp_path / "empty.yaml").write_text("# nobody yet\n")
    assert read_declared(tmp_path / "empty.yaml") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("hosts: [", ":1:9: is not YAML: expected the node content"),
        ("hosts:\n  - name: 'a b'\n", ':2:11: name is "a b"; a name is of letters, digits, `.`, `_` and `-`'),
        ('hosts:\n  - name: "a\\n"\n', ':2:11: name is "a\\n"; a name is'),
        ("hosts:\n  - address: 10.113.11.5\n", ":2:5: this host has no name: write `name: ocu-1`"),
        ("hosts:\n  - a\n", ":2:5: write `- name: ocu-1` for a host"),
        ("hosts:\n  - name: a\n    address: 10.0.0\n", ':3:14: address is "10.0.0"; an IPv4 address is four numbers'),
        ("hosts:\n  - name: a\n    adress: 10.0.0.1\n", ':3:5: unknown key "adress"; did you mean address?'),
        ("hosts:\n  - name: a\n    xyz: b\n", ':3:5: unknown key "xyz"; known here: name, address, groups, tunnel'),
        ("hosts:\n  - name: a\n    name: b\n", ":3:5: name is given twice"),
        ("hosts:\n  - name: a\n  - name: a\n", ":3:5: a is declared twice"),
        ("- a\n", ":1:1: write `hosts:`, and under it `- name: ocu-1` for each host"),
        ("host: []\n", ':1:1: unknown key "host"; did you mean hosts?'),
        ("hosts: 5\n", ":1:8: hosts are a list: write `- name: ocu-1` for each"),
        ("hosts:\n  - name: a\n    groups: ['b c']\n", ":3:13: groups is \"['b c']\"; groups are a list"),
        ("hosts:\n  - name: a\n    tunnel: perhaps\n", ':3:13: tunnel is "perhaps"; a tunnel is true or false'),
        ("hosts:\n  - {name: a, x: 1}\n  - {name: 'b c'}\n", ":3:12: name"),
        ("hosts:\n" + "  - {x: 1}\n" * 9, "known here: name, address, groups, tunnel; and 4 more"),
        ("hosts: &a\n  - {name: *a}\n", "is not YAML: found unconstructable recursive node"),
        (
            "hosts:\n  - {name: a, address: 10.113.11.5}\n  - {name: b, address: 10.113.11.5}\n",
            ":3:5: b and a have the same address",
        ),
        ("x" * (1 << 20 | 1), "longer than"),
        ("[" * 5000, "is not YAML: nested too deep"),
        (b"hosts: \xff\n", "cannot be read: it is not UTF-8 text"),
    ],
)  # fmt: skip
def test_mistakes_are_named(tmp_path: Path, text: str | bytes, said: str) -> None:
    path = tmp_path / "hosts.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(DeclaredHostsError, match=r"hosts\.yaml") as error:
        read_declared(path)
    assert said in str(error.value)


def test_groups_and_unwanted_tunnels_are_read(tmp_path: Path) -> None:
    path = tmp_path / "hosts.yaml"
    path.write_text("hosts:\n  - {name: a, groups: [x, y, x], tunnel: false}\n  - name: b\n")
    declared = DeclaredHosts(path)
    assert declared.hosts["a"].groups == ("x", "y")
    assert [declared.wants(name) for name in ("a", "b", "nobody")] == [False, True, True]


def test_an_invalid_file_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "hosts.yaml"
    path.write_text("hosts:\n  - name: a\n")
    declared = DeclaredHosts(path)
    path.write_text("hosts: 5\n")
    with pytest.raises(DeclaredHostsError):
        declared.reload()
    assert list(declared.hosts) == ["a"]
    assert "hosts.yaml:1:8: hosts are a list" in declared.error
    path.write_text("hosts: []\n")
    declared.reload()
    assert (declared.hosts, declared.error) == ({}, "")


def test_an_invalid_file_changes_nothing_at_a_start(tmp_path: Path) -> None:
    path = tmp_path / "hosts.yaml"
    path.write_text("hosts:\n  - {name: a, tunnel: false}\n")
    kept = DeclaredHosts(path).text
    for broken in (b"hosts: 5\n", b"\xff"):
        path.write_bytes(broken)
        declared = DeclaredHosts(path, text=kept)
        assert not declared.wants("a")
        assert "hosts.yaml" in declared.error
        assert declared.text == kept
    path.unlink()
    assert DeclaredHosts(path, text=kept).wants("a")


def test_the_shipped_file_is_read() -> None:
    path = Path(__file__).parents[3] / "ipsec" / "hosts.yaml"
    assert read_declared(path) == {}


def test_the_example_in_the_file_is_right(tmp_path: Path) -> None:
    shipped = (Path(__file__).parents[3] / "ipsec" / "hosts.yaml").read_text()
    example = [line[2:] for line in shipped.splitlines() if line.startswith(("# hosts:", "#   "))]
    path = tmp_path / "hosts.yaml"
    path.write_text("\n".join(example))
    assert read_declared(path)["ocu-1"].groups == ("operators",)
