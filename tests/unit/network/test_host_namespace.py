from pathlib import Path

from appliance.network.namespaces import bridges, is_contained, lives_on_the_machines_network


def test_only_the_machines_own_network_has_its_settings(tmp_path: Path) -> None:
    settings = tmp_path / "sys/net/core"
    settings.mkdir(parents=True)
    (settings / "somaxconn").touch()
    assert not lives_on_the_machines_network(tmp_path)
    (settings / "netdev_max_backlog").touch()
    assert lives_on_the_machines_network(tmp_path)


def test_a_container_is_known_by_its_engines_mark(tmp_path: Path) -> None:
    assert not is_contained(tmp_path)
    (tmp_path / ".dockerenv").touch()
    assert is_contained(tmp_path)


def test_a_container_is_known_by_its_process_ids(tmp_path: Path) -> None:
    namespaces = tmp_path / "proc/self/ns"
    namespaces.mkdir(parents=True)
    (namespaces / "pid").symlink_to("pid:[4026531836]")
    assert not is_contained(tmp_path)
    (namespaces / "pid").unlink()
    (namespaces / "pid").symlink_to("pid:[4026532211]")
    assert is_contained(tmp_path)


def test_bridges_differ_from_other_interfaces(tmp_path: Path) -> None:
    (tmp_path / "eth0").mkdir()
    assert bridges(tmp_path) == []
    (tmp_path / "docker0" / "bridge").mkdir(parents=True)
    assert bridges(tmp_path) == ["docker0"]
