import json
import os
from pathlib import Path

import pytest

from appliance.channel.admin import AdminAnswer, Trouble
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.configuration.config_sources import plain, resolve
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.membership import Membership, load_membership, path_of
from appliance.features.standby.process import EPOCH, stored_epoch
from appliance.features.standby.requests import StandbyWanted
from appliance.features.standby.witness.settings import read_settings
from appliance.supervisor.state_directory import ADMIN_SOCKET, STORED, StateDirectory
from tests.support.answers import example
from tests.support.command import rosrv

FIRST = ("--address=192.0.2.2", "--other=192.0.2.3", "--witness=192.0.2.10", "--fixed=192.0.2.100")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("p.ini").write_text("[Nodes]\n/talker = *\n[Ports]\nrange = 19001-19100\n")
    Path("appliance.yaml").write_text("policy: p.ini\n")
    return tmp_path


def join_first(out: str = "kit", *more: str, state: str = "first") -> None:
    done = rosrv("standby", "join", "--state", state, *FIRST, "--output", out, *more)
    assert done.returncode == 0, done.stderr


def joined(state: str) -> Membership:
    membership = load_membership(path_of(Path(state)))
    assert membership is not None
    return membership


def write_epoch(state: str, epoch: int) -> Path:
    path = Path(state, "lease", EPOCH)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.parents[1].joinpath("lock").touch()  # it is the state of an appliance that ran
    path.write_text(f"{epoch}\n")
    return path


def test_all_machines_have_keys_that_fit() -> None:
    join_first("kit", "--follower", "arm=192.0.2.11")
    assert rosrv("standby", "join", "kit/standby-b.json", "--state", "second").returncode == 0
    a, b = joined("first"), joined("second")
    assert (a.name, a.address, a.other_address) == (b.other, b.other_address, b.address)
    assert a.peer_key == b.peer_key
    assert (a.certificate, b.certificate) == (b.other_certificate, a.other_certificate)
    witness, arm = (read_settings(f"kit/{folder}/witness.json") for folder in ("witness", "follower-arm"))
    assert [witness.appliances[one.name].key.hex() for one in (a, b)] == [a.witness_key, b.witness_key]
    assert witness.listen == (a.witness, a.witness_port)
    assert arm.followers == witness.followers
    assert (arm.follows_as, arm.fixed) == ("arm", a.fixed)
    assert (arm.listen, arm.ports) == (witness.listen, witness.ports)
    secrets = {a.witness_key, b.witness_key, a.peer_key, arm.followers["arm"].key.hex()}
    assert len(secrets) == 4
    assert not any(
        key in Path("kit/follower-arm/witness.json").read_text() for key in (a.witness_key, b.witness_key)
    )


def test_each_kit_has_a_lease_of_its_own() -> None:
    join_first("one")
    join_first("two", "--force")
    leases = {read_settings(f"{kit}/witness/witness.json").state for kit in ("one", "two")}
    assert len(leases) == 2


def test_the_first_lease_has_a_greater_epoch_than_the_appliance() -> None:
    """Otherwise the witness would refuse the appliance, because it knows a later epoch."""
    write_epoch("first", 41)
    join_first()
    assert "--in-sync a --epoch 42 " in Path("kit/witness/install.sh").read_text()


def test_a_damaged_epoch_is_refused() -> None:
    write_epoch("first", 1).write_text("damaged")
    done = rosrv("standby", "join", "--state", "first", *FIRST, "--output", "kit")
    assert done.returncode == 1 and "does not contain an epoch" in done.stderr
    assert not Path("kit").exists()


def test_the_ports_are_those_of_the_running_appliance() -> None:
    running = plain(resolve(Path("appliance.yaml"), {}, {"listen": "0.0.0.0:12345", "api": "off"}))
    Path("first/run").mkdir(parents=True)
    Path("first/run/config.json").write_text(json.dumps(running))
    Path("first/lock").touch()
    join_first()
    assert read_settings("kit/witness/witness.json").ports == ("12345", "19001-19100", "9090-9099")
    assert "http://192.0.2.100:12345" in Path("kit/witness/install.sh").read_text()


@pytest.mark.parametrize(
    ("listen", "nodes", "expected"),
    [
        (11311, "9000-9050", ("11311", "9000-9050", "9090-9099")),
        (9090, "9300-9400", ("9090", "9300-9400", "9091-9099")),
        (9094, "9300-9400", ("9094", "9300-9400", "9090-9093", "9095-9099")),
        (11311, "9000-9097", ("11311", "9000-9097", "9098-9099")),
        (11311, "9000-9098", ("11311", "9000-9098", "9099")),
    ],
)
def test_the_ports_of_agents_overlap_no_others(listen: int, nodes: str, expected: tuple[str, ...]) -> None:
    Path("p.ini").write_text(f"[Nodes]\n/talker = *\n[Ports]\nrange = {nodes}\n")
    running = plain(resolve(Path("appliance.yaml"), {}, {"listen": f"0.0.0.0:{listen}", "api": "off"}))
    Path("first/run").mkdir(parents=True)
    Path("first/run/config.json").write_text(json.dumps(running))
    Path("first/lock").touch()
    join_first()
    assert read_settings("kit/witness/witness.json").ports == expected
    membership = load_membership(path_of(Path("first")))
    assert membership is not None and membership.ports == expected
    assert range(listen, listen + 1) in (membership.port_ranges() or ())


def test_a_running_appliance_does_not_become_the_other_one() -> None:
    join_first()
    running = StateDirectory(Path("second"))
    try:
        done = rosrv("standby", "join", "kit/standby-b.json", "--state", "second")
    finally:
        running.close()
    assert done.returncode == 1 and "already uses the state directory" in done.stderr
    assert not path_of(Path("second")).exists()


def test_an_epoch_of_another_pair_does_not_count() -> None:
    """If it were greater than the new witness's, the witness would shut out both appliances."""
    join_first("kit", state="first")
    epoch = write_epoch("second", 99)
    assert rosrv("standby", "join", "kit/standby-b.json", "--state", "second").returncode == 0
    assert not epoch.exists()


@pytest.mark.parametrize("leaves", [False, True])
def test_the_epoch_of_the_same_pair_is_kept(leaves: bool) -> None:
    join_first()
    command = ("standby", "join", "kit/standby-b.json", "--state", "second")
    assert rosrv(*command).returncode == 0
    epoch = write_epoch("second", 7)
    if leaves:
        assert rosrv("standby", "leave", "--state", "second").returncode == 0
        assert joined_secrets("second/standby/left.json") == ["", "", ""]
    assert rosrv(*command).returncode == 0
    assert stored_epoch(epoch) == 7


def joined_secrets(path: str) -> list[str]:
    membership = load_membership(Path(path))
    assert membership is not None
    return [membership.witness_key, membership.peer_key, membership.key]


def test_a_failed_write_leaves_neither_kit_nor_membership(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("first/standby/membership.json").mkdir(parents=True)
    Path("first/lock").touch()
    done = rosrv("standby", "join", "--state", "first", *FIRST, "--output", "kit")
    assert done.returncode == 1, done.stdout

    Path("first/standby/membership.json").rmdir()

    def full(descriptor: int, mode: int) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fchmod", full)
    done = rosrv("standby", "join", "--state", "first", *FIRST, "--output", "kit")
    assert done.returncode == 1 and "No space left on device; nothing was changed" in done.stderr
    assert not Path("kit").exists() and not path_of(Path("first")).exists()


@pytest.mark.parametrize("role", ["active", "standby", "single", "unknown", "crashed", "stopped"])
def test_only_an_appliance_that_may_have_all_data_becomes_the_first_again(
    role: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors: dict[str, tuple[Trouble, str]] = {
        "single": ("unknown", "not one"),
        "unknown": ("failed", "it starts"),
    }

    def ask(_socket: AdminSocket, _request: StandbyWanted) -> AdminAnswer[StandbyState]:
        if role == "crashed":
            raise NotRunningError
        if role in errors:
            trouble, error = errors[role]
            return AdminAnswer(False, error=error, trouble=trouble)
        return AdminAnswer(True, example(StandbyState, role=role))

    monkeypatch.setattr(AdminSocket, "ask", ask)
    join_first()
    stored = Path("first", STORED)
    stored.parent.mkdir()
    stored.touch()
    os.utime(stored, (1_772_359_200, 1_772_359_200))
    if role != "stopped":
        Path("first", ADMIN_SOCKET).touch()
    before = joined("first")
    done = rosrv("standby", "join", "--state", "first", *FIRST, "--output", "new", "--force")
    aged = "this appliance last wrote its state on 2026-03-01 10:00Z; it replaces that of b"
    status, text = {
        "standby": (2, "this appliance is the standby: run this on the active one, b (192.0.2.3)"),
        "unknown": (1, "it starts; try again, or stop this appliance first"),
        "crashed": (0, aged),
        "stopped": (0, aged),
    }.get(role, (0, ""))
    assert (done.returncode, joined("first") == before) == (status, status > 0), done.stderr
    assert text in done.stderr and bool(text) is bool(done.stderr)
