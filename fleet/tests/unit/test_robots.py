import errno
import json
import os
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rosrv_fleet import robots as robots_module
from rosrv_fleet.cli import app, robot_app, token_app
from rosrv_fleet.enrolment import EnrolmentError, RobotGroup, require_own_signature
from rosrv_fleet.health import health_of
from rosrv_fleet.indexer import Indexer
from rosrv_fleet.invitations import InvalidInvitationError, Invitations
from rosrv_fleet.robots import Robots
from rosrv_fleet.tokens import FleetRole, OperatorTokens
from typer.testing import CliRunner

from appliance.audit.log.signatures import write_public_key
from appliance.base.atomic_files import write_whole
from appliance.base.clock import now, using
from appliance.signing.own_certificate import make_own_certificate
from fleet.tests.support.collectors import collector_in
from fleet.tests.support.enrolled_robots import enrolled_robots
from tests.support.certificates import make_certificates, own_certificate_until
from tests.support.sources import ROOT
from tests.support.unreadable_folders import make_unreadable
from tests.support.virtual_clock import VirtualClock


@pytest.fixture
def data(tmp_path: Path) -> Path:
    (tmp_path / "fleet.yaml").write_text("data: data\ncertificate: c\nkey: k\n")
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


def _files(folder: Path, name: str) -> tuple[Path, Path]:
    key = folder / f"{name}.pub"
    write_public_key(key, Ed25519PrivateKey.generate().public_key().public_bytes_raw())
    return key, make_certificates(folder / name, authority=name).certificate


def _run(data: Path, *words: str) -> str:
    done = CliRunner().invoke(
        app, [*words, "--config", str(data.parent / "fleet.yaml")], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    return done.output


def test_a_group_is_pinned_and_changed(data: Path, tmp_path: Path) -> None:
    key, certificate = map(str, _files(tmp_path, "arm7"))
    _run(data, "robot", "add", "arm7", "--key", key, "--certificate", certificate, "--group", "site-a/arms")
    assert "arm7  enrolled  site-a/arms" in _run(data, "robot", "list")
    assert _run(data, "robot", "group", "arm7", "site-b/legs") == "arm7 is in site-b/legs\n"
    robots = Robots(data / "robots")
    assert robots.groups() == {"arm7": RobotGroup("site-b", "legs")}
    robots.remove("arm7")
    assert robots.groups() == {}


@pytest.mark.parametrize("group", ["arms", "site-a/", "/arms", "Site/arms", "a/b/c", "site-a/arms\n"])
def test_a_wrong_group_enrols_nothing(group: str, data: Path, tmp_path: Path) -> None:
    key, certificate = _files(tmp_path, "arm7")
    robots = Robots(data / "robots")
    with pytest.raises(EnrolmentError, match="such as site-a/arms"):
        robots.add("arm7", key.read_bytes(), certificate.read_bytes(), group)
    assert robots.all() == {}


def test_an_invitation_keeps_the_group(data: Path, tmp_path: Path) -> None:
    key, certificate = map(str, _files(tmp_path, "arm7"))
    _run(data, "robot", "add", "arm7", "--key", key, "--certificate", certificate, "--group", "site-a/arms")
    (tmp_path / "c").write_bytes(make_own_certificate("rosrv-fleet", 1, "127.0.0.1")[1])
    assert json.loads(_run(data, "robot", "invite", "arm7"))["group"] == "site-a/arms"


@pytest.mark.parametrize("used", [False, True], ids=["unused", "used"])
@pytest.mark.parametrize("act", ["remove", "renew"])
def test_a_changed_robot_has_no_invitation(act: str, used: bool, data: Path, tmp_path: Path) -> None:
    """Otherwise the invitation would let the robot connect with another certificate."""
    key, certificate = map(str, _files(tmp_path, "arm7"))
    _run(data, "robot", "add", "arm7", "--key", key, "--certificate", certificate)
    invitations = Invitations(data / "invitations")
    _pending, token = invitations.add("arm7", "", 60.0)
    if used:
        with invitations.using(token, b"request"):
            pass
    more = ("--certificate", str(_files(tmp_path, "new")[1])) if act == "renew" else ()
    _run(data, "robot", act, "arm7", *more)
    with pytest.raises(InvalidInvitationError), invitations.using(token, b"request"):
        pass
    assert [act["act"] for act in _acts(data) if act["result"] == "done"][-2:] == [
        "invitation withdraw", f"robot {act}"
    ]  # fmt: skip


def test_an_invitation_that_ended_stays_ended(tmp_path: Path) -> None:
    invitations, machine = Invitations(tmp_path / "invitations"), VirtualClock()
    with using(machine):
        _pending, token = invitations.add("arm7", "", 60.0)
        (tmp_path / "invitations" / "strange.json").mkdir()
        for seconds in (61, -3600):
            machine.set_wall(machine.wall_ns() / 1e9 + seconds)
            with pytest.raises(InvalidInvitationError), invitations.using(token, b"request"):
                pass
        _pending, token = invitations.add("arm7", "", 60.0)
        with invitations.using(token, b"request") as used:
            assert used.name == "arm7"


@pytest.mark.parametrize("error", [OSError("the disk is full"), SystemExit()], ids=["failure", "end"])
def test_an_interrupted_request_can_only_be_repeated(error: BaseException, tmp_path: Path) -> None:
    invitations = Invitations(tmp_path / "invitations")
    _pending, token = invitations.add("arm7", "", 60.0)
    with pytest.raises(type(error)), invitations.using(token, b"request") as first:
        raise error
    with pytest.raises(InvalidInvitationError), invitations.using(token, b"another"):
        pass
    with invitations.using(token, b"request") as second:
        assert (first.request, bool(second.request)) == ("", True)


def test_a_repeated_request_changes_nothing(data: Path, tmp_path: Path) -> None:
    key, certificate = (file.read_bytes() for file in _files(tmp_path, "arm7"))
    robots = Robots(data / "robots")
    robots.join("arm7", key, certificate, "site-a/arms")
    robots.move("arm7", "site-b/legs")
    before = _acts(data)
    assert robots.join("arm7", key, certificate, "site-a/arms", again=True).group == "site-b/legs"
    assert _acts(data) == before


@pytest.mark.nightly
def test_two_robots_cannot_join_with_one_key(data: Path, tmp_path: Path) -> None:
    key, certificate = (file.read_bytes() for file in _files(tmp_path, "arm7"))
    begin, refused = threading.Barrier(8), list[str]()

    def join(name: str) -> None:
        begin.wait()
        try:
            Robots(data / "robots").join(name, key, certificate, "site-a/arms")
        except EnrolmentError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=join, args=(f"arm{number}",)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == 7
    assert len(Robots(data / "robots").all()) == 1


def test_acts_are_recorded(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUDO_USER", "olga")
    monkeypatch.setattr("os.getuid", lambda: 0)
    key, certificate = map(str, _files(tmp_path, "arm7"))
    _run(data, "robot", "add", "arm7", "--key", key, "--certificate", certificate, "--group", "site-a/arms")
    _run(data, "robot", "group", "arm7", "site-b/legs")
    _run(data, "robot", "renew", "arm7", "--certificate", str(_files(tmp_path, "new")[1]))
    _run(data, "robot", "remove", "arm7")
    token = _run(data, "token", "add", "alice", "--role", "operator").strip()
    _run(data, "token", "remove", "alice")
    recorded = _acts(data)
    acts = [act for act in recorded if act["result"] == "done"]
    assert [f"{act['act']} {act['about']}" for act in acts] == [
        "robot add arm7", "robot group arm7", "robot renew arm7", "robot remove arm7", "token add alice",
        "token remove alice",
    ]  # fmt: skip
    assert [act["result"] for act in recorded] == ["asked", "done"] * len(acts)
    assert {act["who"] for act in recorded} == {"olga as root"}
    assert (acts[1]["detail"], acts[4]["detail"]) == ("site-b/legs", "operator")
    assert token not in (data / "acts.ndjson").read_text()
    assert (data / "acts.ndjson").stat().st_mode & 0o777 == 0o600


def _acts(data: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in (data / "acts.ndjson").read_text().splitlines()]


def test_no_act_takes_effect_unrecorded(data: Path, tmp_path: Path) -> None:
    (tmp_path / "c").write_bytes(make_own_certificate("rosrv-fleet", 1, "127.0.0.1")[1])
    key, certificate = map(str, _files(tmp_path, "arm7"))
    other_key, other = map(str, _files(tmp_path, "arm8"))
    _run(data, "robot", "add", "arm7", "--key", key, "--certificate", certificate)
    _run(data, "robot", "invite", "arm7")
    _run(data, "token", "add", "alice")
    (data / "acts.ndjson").rename(tmp_path / "acts")
    (data / "acts.ndjson").mkdir()
    before = {file: file.read_bytes() for file in data.rglob("*") if file.is_file()}
    acts: dict[str, Callable[[], object]] = {
        "join": lambda: Robots(data / "robots").join(
            "arm8", Path(other_key).read_bytes(), Path(other).read_bytes(), ""
        )
    }
    cases = {
        "robot invite": ("arm7",),
        "robot add": ("arm8", "--key", other_key, "--certificate", other),
        "robot group": ("arm7", "site-a/arms"),
        "robot renew": ("arm7", "--certificate", other),
        "robot remove": ("arm7",),
        "token add": ("bob",),
        "token remove": ("alice",),
    }
    for name, words in cases.items():
        acts[name] = partial(_run, data, *name.split(), *words)
    known = {
        f"{group} {command.name}"
        for group, commands in (("robot", robot_app), ("token", token_app))
        for command in commands.registered_commands
    }
    assert known - {"robot list", "token list"} == set(cases)
    for name, act in acts.items():
        with pytest.raises(IsADirectoryError):
            act()
        assert {file: file.read_bytes() for file in data.rglob("*") if file.is_file()} == before, name


def test_an_act_that_fails_is_recorded_as_failed(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(file: Path, _data: bytes, _mode: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    key, certificate = (file.read_bytes() for file in _files(tmp_path, "arm7"))
    monkeypatch.setattr(robots_module, "write_whole", fail)
    with pytest.raises(OSError, match="No space left"):
        Robots(data / "robots").add("arm7", key, certificate)
    assert Robots(data / "robots").all() == {}
    asked, failed = _acts(data)
    assert (asked["act"], asked["result"]) == ("robot add", "asked")
    assert failed["result"].startswith("failed: [Errno 28] No space left on device")


@pytest.mark.nightly
def test_a_kill_between_the_record_and_the_change(data: Path, tmp_path: Path) -> None:
    key, certificate = map(str, _files(tmp_path, "arm7"))
    words = ["robot", "add", "arm7", "--key", key, "--certificate", certificate]
    words += ["--config", str(tmp_path / "fleet.yaml")]
    killed = "import os, signal; from rosrv_fleet import cli, robots\n"
    killed += "robots.write_whole = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
    done = subprocess.run(
        [sys.executable, "-c", f"{killed}cli.app({words!r})"],
        cwd=ROOT / "fleet" / "src",
        capture_output=True,
        check=False,
    )
    assert done.returncode == -9, done.stderr
    assert Robots(data / "robots").all() == {}
    assert [act["result"] for act in _acts(data)] == ["asked"]
    with (data / "acts.ndjson").open("ab") as file:
        file.write(b'{"time": "2026-')  # a full disk takes a part of a line
    _run(data, "token", "add", "alice")
    lines = (data / "acts.ndjson").read_text().splitlines()
    assert lines[1] == '{"time": "2026-'
    assert [json.loads(line)["result"] for line in lines[2:]] == ["asked", "done"]


def test_the_stored_hashes_of_secrets_never_change(tmp_path: Path) -> None:
    """The hashes were made with `sha256sum`."""
    operators = tmp_path / "tokens.json"
    digest = "0f007385b6f9d4b7eeb2748605afe1a984a0a3bfa3f014d09e2a784ce9e5cd1a"
    operators.write_text(f'[{{"name": "ann", "role": "viewer", "hash": "{digest}", "added": 0}}]', "ascii")
    holder = OperatorTokens(operators).holder("A" * 43)
    assert holder is not None and holder.name == "ann"
    assert OperatorTokens(operators).holder("A" * 42 + "B") is None
    (tmp_path / "invitations").mkdir()
    file = "6e3a37f4f7e1630b0f42cf9ed119e810259763d3d80332c098eed71eda31a0f3.json"
    (tmp_path / "invitations" / file).write_text('{"name": "arm7", "group": "", "expires": 9e12}', "ascii")
    with Invitations(tmp_path / "invitations").using(f"rosrv-join_{'A' * 43}", b"request") as robot:
        assert robot.name == "arm7"


@pytest.mark.nightly
def test_two_changes_of_tokens_do_not_undo_each_other(tmp_path: Path) -> None:
    tokens = OperatorTokens(tmp_path / "tokens.json")
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: tokens.add(f"operator{number}", FleetRole.VIEWER), range(40)))
    assert len(tokens.all()) == 40


def test_an_unreadable_folder_is_not_an_empty_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "robots"
    folder.mkdir()
    make_unreadable(folder, monkeypatch)
    with pytest.raises(PermissionError):
        Robots(folder).all()


def test_a_change_while_the_folder_is_read_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enrolled_robots(tmp_path, "arm1", "arm2")
    folder, machine = tmp_path / "robots", VirtualClock()
    now = machine.wall_ns()
    second = (folder / "arm2.json").rename(tmp_path / "arm2.json")
    os.utime(folder, ns=(now, now))
    iterdir = Path.iterdir

    def slow(listed: Path) -> Iterator[Path]:
        yield from list(iterdir(listed))
        machine.advance(5)
        if second.exists():
            second.rename(folder / "arm2.json")
            os.utime(folder, ns=(now, now))

    monkeypatch.setattr(Path, "iterdir", slow)
    with using(machine):
        robots = Robots(folder)
        assert robots.known().keys() == {"arm1"}
        assert robots.known().keys() == {"arm1", "arm2"}


@pytest.mark.parametrize(
    ("word", "damaged"),
    [
        ('"name":"arm1"', '"name":"arm2"'),
        ("BEGIN CERTIFICATE", "BEGIN NOTHING"),
        ('"key":"', '"key":"zz'),
        ('"group":""', '"group":"arms"'),
        ("{", ""),
        ("-----BEGIN", "\udcff"),
    ],
    ids=["name", "certificate", "key", "group", "no object", "no UTF-8"],
)
def test_a_damaged_file_affects_no_other_robot(word: str, damaged: str, tmp_path: Path) -> None:
    robots = enrolled_robots(tmp_path, "arm1", "arm2")
    before = robots.all()
    file = tmp_path / "robots" / "arm1.json"
    whole = file.read_text()
    assert word in whole
    write_whole(file, whole.replace(word, damaged, 1).encode(errors="surrogateescape"), 0o600)
    assert robots.known() == before
    assert robots.with_certificate(ssl.PEM_cert_to_DER_cert(before["arm1"].certificate)) == before["arm1"]
    assert Robots(tmp_path / "robots").known() == {"arm2": before["arm2"]}
    assert robots.trouble is not None
    assert str(file) in robots.trouble
    with pytest.raises(EnrolmentError, match="repair it"):  # perhaps arm1 has this certificate
        robots.renew("arm2", make_own_certificate("arm2", 1)[1])
    before["arm2"] = robots.move("arm2", "site-a/arms")
    with pytest.raises(EnrolmentError, match="repair it"):
        Robots(tmp_path / "robots").require("arm1")
    file.write_text(whole)
    with using(VirtualClock(now=now() + 2)):  # it reads the folder again after a second
        assert robots.known() == before
    assert robots.trouble is None


def test_a_damaged_file_delays_no_revocation(data: Path) -> None:
    enrolled_robots(data, "arm1", "arm2")
    (data / "robots" / "arm1.json").write_text("{")
    _run(data, "robot", "remove", "arm2")
    listed = CliRunner().invoke(app, ["robot", "list", "--config", str(data.parent / "fleet.yaml")])
    assert listed.exit_code == 1
    assert "arm2  removed" in listed.stdout


_NO_TIMES = [b"\x18\x0f00000101000000Z", b"\x18\x0f20260101000099Z", b"\x17\x0d261301000000Z"]


@pytest.mark.parametrize("until", _NO_TIMES, ids=["year 0", "second 99", "month 13"])
def test_a_certificate_without_a_time_is_refused(until: bytes, tmp_path: Path) -> None:
    certificate = own_certificate_until(until)
    key, _ = _files(tmp_path, "arm1")
    with pytest.raises(EnrolmentError, match="not a valid certificate"):
        require_own_signature(certificate)
    with pytest.raises(EnrolmentError, match="not a valid certificate"):
        Robots(tmp_path / "robots").join("arm1", key.read_bytes(), certificate, "")
    assert Robots(tmp_path / "robots").all() == {}
    require_own_signature(own_certificate_until(b"\x18\x0f99991231235959Z"))


def test_a_stored_certificate_without_a_time_hides_no_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Indexer, "trouble", None)  # no database runs
    before = enrolled_robots(tmp_path, "arm1", "arm2").all()
    bad = msgspec.structs.replace(before["arm1"], certificate=own_certificate_until(_NO_TIMES[0]).decode())
    write_whole(tmp_path / "robots" / "arm1.json", msgspec.json.encode(bad), 0o600)
    health = health_of(collector_in(tmp_path))
    assert [robot.name for robot in health.robots] == ["arm2"]
    assert health.trouble is not None
    assert "arm1.json" in health.trouble


def test_whatever_certificate_is_accepted_can_be_shown(tmp_path: Path) -> None:
    whole = ssl.PEM_cert_to_DER_cert(make_own_certificate("arm1", 1)[1].decode())
    key, _ = (file.read_bytes() for file in _files(tmp_path, "arm1"))
    robots, accepted = Robots(tmp_path / "robots"), 0
    for place in range(len(whole)):
        changed = whole[:place] + bytes([whole[place] ^ 0x21]) + whole[place + 1 :]
        with suppress(EnrolmentError):
            robots.join("arm1", key, ssl.DER_cert_to_PEM_cert(changed).encode(), "")
            accepted += 1
    (robot,) = health_of(collector_in(tmp_path)).robots
    assert robot.name == "arm1"
    assert 0 < accepted < len(whole)
