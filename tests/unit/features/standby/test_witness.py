import ast
import errno
import json
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from appliance.features.standby import witness as program
from appliance.features.standby.witness import (
    ANSWER,
    EXPIRY,
    LONGEST,
    REQUEST,
    AppliancePeer,
    BoundedLog,
    IdleConnections,
    LeaseEnforcement,
    LeaseFile,
    LeaseFirewall,
    LeaseRecord,
    Left,
    RegularCheck,
    UncertainError,
    Witness,
    WitnessError,
    WitnessGate,
    WitnessSettings,
    chosen_backend,
    forgetting,
    main,
    nft_rules,
    seal,
    sockets_with,
    unseal,
)

KEYS = {"a": b"a" * 32, "b": b"b" * 32}
PEERS = {"a": AppliancePeer("10.0.0.2", KEYS["a"]), "b": AppliancePeer("10.0.0.3", KEYS["b"])}
PAIR_SETTINGS = WitnessSettings(("10.0.0.1", 7411), "10.0.0.100", ("11311",), PEERS, "/lease", {}, "")
BOTH = ("a", "b")
FIRST = LeaseRecord(1, "", BOTH, "")


class Robot:
    def __init__(self, record: LeaseRecord | None = FIRST, boot: str = "one") -> None:
        self.now = 100.0
        self.disk = record
        self.admits: list[str] = []
        self.disk_full = self.firewall_fails = self.uncertain = False
        self.witness = Witness(
            record=record, save=self.save, admit=self.admit, boot=boot, clock=lambda: self.now
        )
        self.gate = WitnessGate(self.witness, PEERS, "nonce")

    def save(self, record: LeaseRecord) -> None:
        if self.disk_full:
            raise self.failure("the disk is full")
        self.disk = record

    def admit(self, name: str) -> None:
        if self.firewall_fails:
            raise self.failure("nft: no")
        self.admits.append(name)

    @property
    def failure(self) -> type[WitnessError]:
        return UncertainError if self.uncertain else WitnessError

    def asks(self, name: str, operation: str, epoch: int = 1) -> str:
        return self.witness.handle(name, operation, epoch, "b" if name == "a" else "a")

    def expired(self) -> "Robot":
        self.now += EXPIRY
        return self


def granted() -> Robot:
    robot = Robot().expired()
    assert robot.asks("a", "claim") == ""
    return robot


def test_the_first_grant_comes_one_expiry_after_the_start() -> None:
    robot = Robot()
    assert robot.admits == [""]
    robot.now += EXPIRY - 0.01
    assert "no appliance holds the lease" in robot.asks("a", "claim")
    robot.now += 0.02
    assert robot.asks("a", "claim") == ""
    assert robot.admits == ["", "a"]
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")


def test_a_claim_waits_until_the_last_renewal_has_expired() -> None:
    robot = granted()
    robot.now += 1
    assert robot.asks("a", "renew", 2) == ""
    robot.now += 1
    assert robot.asks("b", "claim", 2) == "a holds the lease for another 0.2 s"
    assert robot.expired().asks("b", "claim", 2) == ""
    assert robot.asks("a", "renew", 2) == "b holds epoch 3"


def test_only_an_appliance_in_sync_gets_the_lease() -> None:
    robot = granted()
    assert robot.asks("b", "remove", 2) == "a holds epoch 2"
    assert robot.asks("a", "remove", 2) == ""
    assert robot.disk is not None and robot.disk.in_sync == ("a",)
    assert robot.expired().asks("b", "claim", 2) == "b is not in sync"
    assert robot.asks("a", "add", 2) == ""
    assert robot.asks("b", "claim", 2) == ""


def test_a_released_lease_is_granted_at_once() -> None:
    robot = granted()
    assert robot.asks("b", "release", 2) == "a holds epoch 2"
    assert robot.asks("a", "release", 2) == ""
    assert robot.asks("b", "claim", 2) == ""


def test_an_epoch_never_falls() -> None:
    robot = granted().expired()
    assert robot.asks("a", "claim", 2) == ""
    assert robot.asks("a", "renew", 2) == "a holds epoch 3"
    assert "run witness.py begin" in robot.expired().asks("b", "claim", 9)


def test_a_full_disk_grants_nothing_and_keeps_the_holder() -> None:
    robot = granted()
    robot.disk_full = True
    assert robot.asks("a", "renew", 2) == ""
    assert robot.asks("a", "remove", 2) == "the disk is full"
    assert robot.expired().asks("b", "claim", 2) == "the disk is full"
    assert robot.admits == ["", "a"]
    assert robot.asks("a", "renew", 2) == ""


def test_a_failing_firewall_grants_nothing() -> None:
    robot = granted().expired()
    robot.firewall_fails = True
    assert robot.asks("b", "claim", 2) == "nft: no"
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")
    assert robot.asks("a", "renew", 2) == "", "its rules have not changed"
    assert robot.admits == ["", "a"]


def test_uncertain_rules_are_written_again_before_the_next_renewal() -> None:
    robot = granted().expired()
    robot.firewall_fails = robot.uncertain = True
    assert robot.asks("b", "claim", 2) == "nft: no"
    assert robot.asks("a", "renew", 2) == "nft: no", "they may admit b"
    robot.firewall_fails = False
    assert robot.asks("a", "renew", 2) == ""
    assert robot.admits == ["", "a", "a"]


def test_rules_that_cannot_be_listed_stop_takeovers_and_no_renewal() -> None:
    robot = granted().expired()
    robot.witness.unknown_rules = "nft: not found"
    assert robot.asks("b", "claim", 2) == "nft: not found"
    assert robot.disk == LeaseRecord(2, "a", BOTH, "one")
    assert robot.asks("a", "renew", 2) == ""
    robot.witness.unknown_rules = ""
    assert robot.expired().asks("b", "claim", 2) == ""


@pytest.mark.parametrize(("operation", "names"), [("remove", ("a",)), ("add", BOTH)])
def test_until_an_uncertain_change_is_settled_the_holder_waits_for_the_standby(
    operation: str, names: tuple[str, ...]
) -> None:
    before = BOTH if operation == "remove" else ("a",)
    robot = Robot(LeaseRecord(2, "a", before, "one"))
    robot.disk_full = robot.uncertain = True
    assert robot.asks("a", operation, 2) == "the disk is full"
    answer = answered(robot, request(do="renew", epoch=2))
    assert answer is not None and (answer["ok"], answer["in_sync"]) == (True, ["a", "b"])
    robot.expired()
    assert "b is not in sync" in robot.asks("b", "claim", 2) or operation == "remove"
    robot.disk_full, robot.disk = False, FIRST
    robot.witness.settle()
    assert robot.disk == LeaseRecord(2, "a", before, "one")
    answer = answered(robot, request(do="renew", epoch=2, number=2))
    assert answer is not None and answer["in_sync"] == list(before)
    assert robot.asks("a", operation, 2) == "" and robot.disk.in_sync == names


def test_a_slow_check_is_reported_while_it_runs() -> None:
    now, seen = [0.0], []

    def check() -> None:
        for seconds in (4.9, 0.2):
            now[0] += seconds
            seen.append(checked.trouble())

    checked = RegularCheck("the rules cannot be listed", check, lambda: now[0])
    checked.run()
    assert seen == ["", "the rules cannot be listed: that takes more than 5 s"]
    assert checked.trouble() == ""


def test_a_restart_of_the_witness_alone_changes_no_rule() -> None:
    record = LeaseRecord(2, "a", BOTH, "one")
    assert Robot(record, "one").admits == ["a"]
    robot = Robot(record, "two")
    assert robot.admits == [""]
    assert robot.asks("a", "renew", 2) == ""
    assert robot.admits == ["", "a"]
    assert robot.disk == LeaseRecord(2, "a", BOTH, "two")


def test_without_a_lease_both_are_shut_out() -> None:
    robot = Robot(None).expired()
    for operation in program.OPERATIONS:
        assert "witness.py begin" in robot.asks("a", operation)
    assert robot.admits == [""]
    robot.witness.enforce_again()
    assert robot.admits == ["", ""]


def test_rules_that_another_program_removed_are_written_again() -> None:
    robot = granted()
    robot.witness.enforce_again()
    assert robot.admits == ["", "a", "a"]


# ---- Datagrams


def request(name: str = "a", key: bytes | None = None, **body: object) -> bytes:
    full = {"boot": "nonce", "session": "mine", "number": 1, "do": "claim", "epoch": 1} | body
    return seal(REQUEST, name, key or KEYS[name], full)


def answered(robot: Robot, datagram: bytes, address: str = "10.0.0.2") -> dict[str, object] | None:
    answer = robot.gate.answer(datagram, address)
    return None if answer is None else unseal(ANSWER, KEYS["a"], answer)


def test_an_answer_repeats_session_and_number() -> None:
    assert answered(Robot().expired(), request()) == {
        "boot": "nonce", "session": "mine", "number": 1, "ok": True, "reason": "", "epoch": 2, "holder": "a",
        "in_sync": ["a", "b"], "expired": False, "trouble": "", "followers": "",
    }  # fmt: skip


def test_a_look_changes_nothing() -> None:
    robot = Robot().expired()
    answers = [
        answered(robot, request(do=operation, number=number, epoch=epoch))
        for number, (operation, epoch) in enumerate((("look", 1), ("claim", 1), ("look", 2)), 1)
    ]
    assert [one and (one["ok"], one["epoch"], one["expired"]) for one in answers] == [
        (True, 1, True), (True, 2, False), (True, 2, False),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("datagram", "address"),
    [
        (b"", "10.0.0.2"),
        (b"\xff" * LONGEST, "10.0.0.2"),
        (request() + b" " * LONGEST, "10.0.0.2"),
        (request(key=KEYS["b"]), "10.0.0.2"),
        (request(), "10.0.0.3"),
        (request()[:-1] + b"]", "10.0.0.2"),
        (seal(ANSWER, "a", KEYS["a"], {"boot": "nonce"}), "10.0.0.2"),
        (request(number=-1), "10.0.0.2"),
        (request(number=True), "10.0.0.2"),
        (request(number=1 << 60), "10.0.0.2"),
        (request(epoch="1"), "10.0.0.2"),
        (request(do="begin"), "10.0.0.2"),
        (request(do=["claim"]), "10.0.0.2"),
        (request(session="x" * 33), "10.0.0.2"),
        (request(more=1), "10.0.0.2"),
    ],
)
def test_a_request_that_is_not_authentic_and_well_formed_gets_no_answer(
    datagram: bytes, address: str
) -> None:
    robot = Robot().expired()
    assert robot.gate.answer(datagram, address) is None
    assert robot.gate.rejected == 1
    assert robot.admits == [""]


def test_a_replayed_request_changes_nothing() -> None:
    robot = granted()
    removal, addition = (
        request(do="remove", epoch=2, number=5),
        request(do="add", epoch=2, number=4, session="old"),
    )
    assert answered(robot, removal) is not None
    for old in (removal, addition):
        assert robot.disk is not None and robot.disk.in_sync == ("a",)
        answer = answered(robot, old)
        assert answer is not None and answer["stale"] is True and answer["last"] == 5


def test_only_a_new_request_moves_the_socket_of_an_appliance() -> None:
    """The witness must not send to the source port of a forged, replayed or earlier datagram."""
    robot = granted()
    seen = []
    for datagram, address in (
        (request(do="renew", epoch=2, number=5), "10.0.0.2"),
        (request(do="renew", epoch=2, number=5), "10.0.0.2"),
        (request(do="renew", epoch=2, number=4), "10.0.0.2"),
        (request(do="renew", epoch=2, number=6, boot="earlier"), "10.0.0.2"),
        (request(do="renew", epoch=2, number=6, key=KEYS["b"]), "10.0.0.2"),
        (request(do="renew", epoch=2, number=6), "10.0.0.3"),
        (request(do="renew", epoch=2, number=6), "10.0.0.2"),
    ):
        robot.gate.answer(datagram, address)
        seen.append(robot.gate.fresh)
    assert seen == ["a", "", "", "", "", "", "a"]


def test_a_request_to_an_earlier_start_changes_nothing() -> None:
    robot = Robot().expired()
    answer = answered(robot, request(boot="earlier"))
    assert answer == {"boot": "nonce", "session": "mine", "number": 1, "stale": True, "last": 0}
    assert robot.admits == [""]


# ---- The file


def test_the_lease_survives_on_the_disk(tmp_path: Path) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    assert not file.has_room()
    stats = []
    for record in (LeaseRecord(7, "a", ("a",), "x"), LeaseRecord(8, "b", BOTH, "x")):
        file.write(record)
        assert file.read() == record
        stats.append((tmp_path / "lease").stat())
    before, after = stats
    assert (after.st_ino, after.st_size, after.st_mode & 0o777) == (before.st_ino, before.st_size, 0o600)


@pytest.mark.parametrize(("end", "epoch"), [(0, 7), (100, 7), (4096, 8), (4196, 8), (8192, 8)])
def test_a_crash_leaves_the_old_lease_or_the_new_one(tmp_path: Path, end: int, epoch: int) -> None:
    path, made = tmp_path / "lease", []
    file = LeaseFile(str(path), BOTH)
    for number in (7, 8):
        file.write(LeaseRecord(number, "a" * (number == 8), BOTH, "x"))
        made.append(path.read_bytes())
    path.write_bytes(made[1][:end] + made[0][end:])
    assert file.read().epoch == epoch


def test_the_lease_of_an_earlier_version_is_read_and_gets_room(tmp_path: Path) -> None:
    file, record = LeaseFile(str(tmp_path / "lease"), BOTH), LeaseRecord(7, "a", BOTH, "x")
    file.write(record)
    (tmp_path / "lease").write_bytes((tmp_path / "lease").read_bytes()[:4096].rstrip())
    assert file.read() == record and not file.has_room()
    file.write(record._replace(epoch=8))
    assert file.read().epoch == 8 and file.has_room()


def test_a_disk_that_cannot_be_written_is_reported_in_each_answer(tmp_path: Path) -> None:
    now = [0.0]
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    disk = RegularCheck("the disk cannot be written", file.check_disk, lambda: now[0])
    file.write(FIRST)
    disk.run()
    assert disk.trouble() == ""
    (tmp_path / "lease.check").unlink()
    (tmp_path / "lease.check").symlink_to("/dev/full")
    disk.run()
    assert disk.trouble() == "the disk cannot be written: [Errno 28] No space left on device"
    robot = granted()
    robot.witness.trouble = disk.trouble()
    answer = answered(robot, request(do="look", epoch=2))
    assert answer is not None and answer["trouble"] == disk.trouble()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: b"",
        lambda text: text[:-1],
        lambda text: text.replace(b'"epoch": 7', b'"epoch": 8'),
        lambda text: b"\xff" + text,
    ],
)
def test_a_damaged_lease_is_refused(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    file.write(LeaseRecord(7, "a", BOTH, "x"))
    (tmp_path / "lease").write_bytes(damage((tmp_path / "lease").read_bytes()))
    with pytest.raises(WitnessError, match=r"lease cannot be used: .*begin --in-sync NAMES --epoch N"):
        file.read()


@pytest.mark.parametrize(
    "record",
    [
        LeaseRecord(-1, "a", BOTH, ""),
        LeaseRecord(1, "a", ("a", "c"), ""),
        LeaseRecord(1, "", (), ""),
        LeaseRecord(1, "b", ("a",), ""),
    ],
)
def test_a_lease_of_other_appliances_is_refused(tmp_path: Path, record: LeaseRecord) -> None:
    file = LeaseFile(str(tmp_path / "lease"), BOTH)
    file.write(record)
    with pytest.raises(WitnessError):
        file.read()


def test_a_save_that_fails_keeps_the_lease() -> None:
    with pytest.raises(WitnessError, match="cannot be saved"):
        LeaseFile("/dev/full/lease", BOTH).write(LeaseRecord(1, "", BOTH, ""))


# ---- Settings and commands


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "witness.json"
    path.write_text(
        json.dumps(
            {
                "listen": "10.0.0.1:7411",
                "fixed": "10.0.0.100",
                "ports": ["11311", "20000-20999"],
                "appliances": {
                    "a": {"address": "10.0.0.2", "key": "aa" * 32},
                    "b": {"address": "10.0.0.3", "key": "bb" * 32},
                },
                "state": str(tmp_path / "state/lease"),
            }
        )
    )
    path.chmod(0o600)
    return path


def test_begin_writes_a_lease_with_a_greater_epoch(
    settings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["begin", "--settings", str(settings)]
    assert main([*command, "--in-sync", "a,b", "--epoch", "5"]) == 0
    file = LeaseFile(str(settings.parent / "state/lease"), BOTH)
    assert file.read() == LeaseRecord(5, "", BOTH, "")
    for wrong, option in (("a 5", "--epoch"), ("c 9", "--in-sync"), (" 9", "--in-sync"), ("a -1", "--epoch")):
        names, epoch = wrong.split(" ")
        assert main([*command, f"--in-sync={names}", f"--epoch={epoch}"]) == 1
        assert capsys.readouterr().err.startswith(f"witness.py: {option}: ")
    assert file.read().epoch == 5


def test_begin_waits_until_the_witness_is_stopped(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A running witness would write its own lease again."""
    with LeaseFile(str(settings.parent / "state/lease"), BOTH):
        assert main(["begin", "--settings", str(settings), "--in-sync", "a", "--epoch", "5"]) == 1
    assert "systemctl stop rosrv-witness" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"aa', '"bb', "a key of its own"),
        ("10.0.0.3", "10.0.0.2", "different addresses"),
        ("10.0.0.3", "127.0.0.1", "cannot be an address"),
        ("10.0.0.3", "fd00::1", "fd00::1"),
        ('"aaaa', '"zzaa', "64 hexadecimal digits"),
        ('"11311"', '"0"', "not a port or a range"),
        ('"11311", "20000-20999"', "", "ports is empty"),
        ('"fixed"', '"fix"', "'fixed' is missing"),
        ('"a"', '"../a"', "is not valid"),
        ("{", "", ""),
    ],
)
def test_wrong_settings_are_rejected_with_the_reason(
    settings: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, reason: str
) -> None:
    text = settings.read_text()
    changed = text.replace(old, new)
    if old == '"aa':
        changed = text.replace("aa" * 32, "bb" * 32)
    settings.write_text(changed)
    assert main(["shut", "--settings", str(settings)]) == 1
    error = capsys.readouterr().err
    assert f"the settings {settings} cannot be used: " in error and reason in error


def test_keys_that_others_can_read_are_rejected(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings.chmod(0o640)
    assert main(["serve", "--settings", str(settings)]) == 1
    assert f"chmod 600 {settings}" in capsys.readouterr().err


def test_the_log_is_bounded() -> None:
    lines: list[str] = []
    now = [0.0]
    log = BoundedLog(lines.append, lambda: now[0])
    for number in range(100):
        log.add(str(number))
    now[0] = 11.0
    log.add("later")
    assert lines == [f"{number}\n" for number in range(20)] + ["80 more lines were left out\n", "later\n"]


def test_the_backend_is_nft_from_linux_4_18() -> None:
    assert chosen_backend("4.18.0-25-generic", lambda name: name) == "nft"
    assert chosen_backend("4.4.0-210", lambda name: name) == "iptables"
    assert chosen_backend("6.1", {"iptables-restore": "/sbin/iptables-restore"}.get) == "iptables"
    with pytest.raises(WitnessError, match="apt install nftables"):
        chosen_backend("6.1", lambda name: None)


def test_connections_are_found_in_the_tables_of_the_kernel() -> None:
    row = "   0: {} {} {} 00000000:00000000 00:00000000 00000000 0 0 1"
    mapped = "0000000000000000FFFF0000"
    table = "\n".join(
        [
            "head",
            row.format("0100000A:D431", "0200000A:2C2F", "01"),
            row.format("0100000A:D432", "0200000A:2C2F", "0A"),
            row.format("0100000A:D433", "0300000A:2C2F", "01"),
        ]
    )
    table6 = "\n".join(
        [
            "head",
            row.format(mapped + "0100000A:D434", mapped + "0200000A:2C2F", "08"),
            row.format("0" * 32 + ":D434", "1" * 32 + ":1", "01"),
        ]
    )
    assert sockets_with({"10.0.0.2"}, [table, table6]) == [
        ("10.0.0.1", 0xD431, "10.0.0.2", 11311),
        ("10.0.0.1", 0xD434, "10.0.0.2", 11311),
    ]


def test_a_message_deletes_a_connection_from_the_tracker() -> None:
    """The attributes of nfnetlink_conntrack.h are nested, and each is padded to four bytes."""
    message = forgetting(("10.0.0.1", 0xD431, "10.0.0.2", 11311))
    assert struct.unpack("=IHHII", message[:16]) == (len(message), 0x102, 1, 0, 0)
    tuple_of = (
        "3400018014000180080001000a000001080002000a0000021c000280050001000600000006000200d431000006000300"
    )
    assert message[16:].hex() == "02000000" + tuple_of + "2c2f0000"


def test_a_kernel_without_the_trackers_interface_stops_no_witness(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_given: object) -> None:
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")

    monkeypatch.setattr(socket, "socket", missing)
    program.forget([("10.0.0.1", 0xD431, "10.0.0.2", 11311)])


# ---- The file runs on the robot as it is


SOURCE = Path(program.__file__).read_text()


@pytest.mark.nightly
def test_it_runs_on_python_3_5() -> None:
    ast.parse(SOURCE, feature_version=(3, 5))
    command = [str(Path(sys.executable).with_name("vermin")), "--no-tips", "--target=3.5-", program.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_its_patterns_compile_on_python_3_5() -> None:
    """Before 3.11 the `re` module has no possessive quantifiers, and the witness would end at its start."""
    newer = re.compile(r"[*+?}]\+|\(\?>")
    assert newer.search(r"\d++") is not None
    patterns = [
        node.args[0].value
        for node in ast.walk(ast.parse(SOURCE))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func).startswith("re.")
        and isinstance(node.args[0], ast.Constant)
        and isinstance(node.args[0].value, str)
    ]
    assert patterns
    assert [one for one in patterns if newer.search(one)] == []


def test_it_imports_only_the_standard_library() -> None:
    imported = {
        name.partition(".")[0]
        for node in ast.walk(ast.parse(SOURCE))
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert imported <= sys.stdlib_module_names


@pytest.mark.parametrize(
    ("tables", "intact"), [("table inet other\n", False), ("table ip rosrv_witness\n", None), (None, None)]
)
def test_a_table_that_is_gone_differs_from_a_program_that_fails(
    tables: str | None, intact: bool | None
) -> None:
    rules = ["table ip rosrv_witness { }"]

    def run(command: list[str], _text: str, _left: object) -> str:
        found = {"-f": "", "table": rules[0], "tables": tables}[command[1 if command[1] == "-f" else 2]]
        if not found and command[1] == "list":
            raise WitnessError("nft: no")
        return found or ""

    firewall = LeaseFirewall(PAIR_SETTINGS, "nft", run)
    firewall.admit("a")
    assert firewall.intact(firewall.present())
    rules[0] = ""
    if intact is None:
        with pytest.raises(WitnessError):
            firewall.present()
    else:
        assert firewall.intact(firewall.present()) is intact


def test_rules_that_change_before_they_are_first_read_are_not_taken_for_ours() -> None:
    firewall = LeaseFirewall(PAIR_SETTINGS, "iptables", lambda _command, _text, _left: "*filter\nCOMMIT\n")
    firewall.admit("a")
    assert not firewall.intact(firewall.present())


class FakeProgram:
    """The programs of the firewall. `meanwhile` happens while the given kind of them runs."""

    def __init__(self) -> None:
        self.rules = ""
        self.fails: dict[str, type[WitnessError]] = {}
        self.meanwhile: dict[str, Callable[[], None]] = {}
        self.ran: list[str] = []

    def __call__(self, command: list[str], text: str, _left: Left) -> str:
        kinds = {"-f": "write", "--noflush": "write", "-c": "trial", "--test": "trial"}
        kind = next((kinds[word] for word in command[1:] if word in kinds), "list")
        self.ran.append(kind)
        listed = self.rules
        self.meanwhile.pop(kind, lambda: None)()
        if kind in self.fails:
            raise self.fails[kind]("nft: no")
        if kind == "write":
            self.rules = text
        return listed


class NoConnections:
    def connecting(self) -> list[object]:
        return []

    def reset(self, _name: str, _connecting: object) -> None:
        pass

    def go_on(self) -> bool:
        return False


def enforced(backend: str = "nft") -> tuple[FakeProgram, LeaseEnforcement, list[str]]:
    program, lines = FakeProgram(), list[str]()
    log = BoundedLog(lines.append, lambda: 0.0)
    firewall = LeaseFirewall(PAIR_SETTINGS, backend, program)
    idle = cast("IdleConnections", NoConnections())
    return program, LeaseEnforcement(firewall, idle, PAIR_SETTINGS.appliances, log, lambda: 0.0), lines


def looked_after(enforcement: LeaseEnforcement) -> bool:
    """Return whether the rules are written again."""
    again = []
    enforcement.go_on(lambda: again.append(True))
    return bool(again)


def test_a_change_by_another_program_is_undone_and_named() -> None:
    program, enforcement, lines = enforced()
    enforcement.admit("a")
    enforcement.listing.run()
    assert not looked_after(enforcement)
    program.rules = "changed"
    enforcement.listing.run()
    assert looked_after(enforcement)
    assert "another program changed the firewall rules" in lines[-1]


def test_a_listing_that_overlaps_a_write_accuses_no_program() -> None:
    """A list is begun, in turn, at each step of a write, and ended at each later one."""
    program, enforcement, lines = enforced()
    enforcement.admit("a")
    program.meanwhile["list"] = lambda: enforcement.admit("b")  # a whole write during a listing
    enforcement.listing.run()
    assert not looked_after(enforcement)
    program.meanwhile["write"] = enforcement.listing.run  # a whole listing during a write
    enforcement.admit("a")
    assert not looked_after(enforcement)

    def begin() -> None:  # a listing during the reading that follows a write
        program.meanwhile["list"] = enforcement.listing.run

    program.meanwhile["write"] = begin
    enforcement.admit("b")
    assert not looked_after(enforcement)
    assert all("another program" not in line for line in lines)


def test_rules_that_were_not_read_are_written_again_and_accuse_no_program() -> None:
    program, enforcement, lines = enforced()
    program.fails["list"] = UncertainError
    enforcement.admit("a")
    program.fails.clear()
    enforcement.listing.run()
    assert looked_after(enforcement)
    assert "could not be read after they were written" in lines[-1]


def test_rules_that_could_not_be_written_leave_the_earlier_ones_intact() -> None:
    program, enforcement, _ = enforced()
    enforcement.admit("a")
    program.fails["write"] = WitnessError
    with pytest.raises(WitnessError):
        enforcement.admit("b")
    enforcement.listing.run()
    assert not looked_after(enforcement)


@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_a_takeover_whose_rules_cannot_be_written_is_known_before(backend: str) -> None:
    program, enforcement, _ = enforced(backend)
    enforcement.trial.run()
    assert enforcement.trouble() == ""
    program.fails["trial"] = WitnessError
    enforcement.trial.run()
    assert enforcement.trouble() == "the firewall rules of a takeover cannot be written: nft: no"
    enforcement.admit("a")
    assert program.ran[-1] == "list", "a trial that fails delays no write"
    program.fails.clear()
    enforcement.trial.run()
    assert enforcement.trouble() == ""


@pytest.mark.parametrize("admitted", ["", "a", "b"])
def test_the_trial_is_of_the_other_appliances_rules(admitted: str) -> None:
    texts = []

    def run(command: list[str], text: str, _left: Left) -> str:
        texts.extend([text] if "-c" in command else [])
        return ""

    firewall = LeaseFirewall(PAIR_SETTINGS, "nft", run)
    idle = cast("IdleConnections", NoConnections())
    log = BoundedLog(lambda _line: None, lambda: 0.0)
    enforcement = LeaseEnforcement(firewall, idle, PAIR_SETTINGS.appliances, log, lambda: 0.0)
    enforcement.admit(admitted)
    enforcement.trial.run()
    assert texts == [nft_rules(PAIR_SETTINGS, "b" if admitted == "a" else "a")]


def test_a_trial_gives_way_to_a_write_and_keeps_its_earlier_result() -> None:
    program, enforcement, _ = enforced("iptables")
    program.fails["trial"] = WitnessError
    enforcement.trial.run()
    failure = enforcement.trouble()
    firewall, left = enforcement.firewall, list[float]()

    def run(_command: list[str], _text: str, still: Left) -> str:
        left.append(still())
        firewall.waiting = True  # as `admit` does in another thread
        left.append(still())
        raise UncertainError("iptables-restore: ended")

    firewall._run = run
    enforcement.trial.run()
    assert left[0] > 0 == left[1]
    assert enforcement.trouble() == failure != ""
