from pathlib import Path

import pytest

from appliance.features.standby.witness.enforcement import RegularCheck
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.protocol import ANSWER, LONGEST, REQUEST, seal, unseal
from tests.unit.features.standby.witness.robot import BOTH, FIRST, KEYS, Robot, granted


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
    assert [answer and (answer["ok"], answer["epoch"], answer["expired"]) for answer in answers] == [
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
