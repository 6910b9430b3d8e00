import contextlib
import json
import random
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from appliance.features.standby.witness.enforcement import BoundedLog
from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.firewall_rules import iptables_rules, nft_rules
from appliance.features.standby.witness.follower import WitnessFollower
from appliance.features.standby.witness.following import followed_epoch
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.program import main
from appliance.features.standby.witness.protocol import (
    ANSWER,
    EXPIRY,
    HIGHEST,
    OPERATIONS,
    REQUEST,
    Left,
    seal,
    unseal,
)
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import AppliancePeer, read_settings
from tests.unit.features.standby.mutants import WITNESS, Mutant, product_of
from tests.unit.features.standby.simulation import delivered_witness

BOTH = ("a", "b")
KEY = b"f" * 32
APPLIANCES = {
    name: AppliancePeer(f"10.0.0.{number}", name.encode() * 32) for number, name in enumerate(BOTH, 2)
}
FOLLOWERS = {"arm": AppliancePeer("10.0.0.20", KEY)}


class Robot:
    def __init__(self, epoch: int = 0) -> None:
        self.now = 100.0
        self.robot_admits: list[str] = []
        self.follower_admits: list[str] = []
        self.saved: list[int] = []
        self.broken = False
        self.number = 0
        self.start_witness(LeaseRecord(1, "", BOTH, ""))
        self.start_follower(epoch)

    def start_witness(self, record: LeaseRecord | None, boot: str = "one") -> None:
        self.witness = Witness(
            record=record,
            save=lambda _record: None,
            admit=self.robot_admits.append,
            boot=boot,
            clock=lambda: self.now,
        )
        self.gate = WitnessGate(self.witness, APPLIANCES, f"nonce {id(self.witness)}", FOLLOWERS)

    def start_follower(self, epoch: int = 0, session: str = "first") -> None:
        self.follower = WitnessFollower(
            name="arm", key=KEY, appliances=BOTH, session=session, epoch=epoch, save=self._save,
            admit=self._admit, clock=lambda: self.now,
        )  # fmt: skip

    def _save(self, epoch: int) -> None:
        if self.broken:
            raise WitnessError("the disk is full")
        self.saved.append(epoch)

    def _admit(self, name: str, _left: Left) -> None:
        if self.broken:
            raise WitnessError("nft: no")
        self.follower_admits.append(name)

    def claim(self, name: str) -> None:
        self.now += EXPIRY
        assert self.witness.handle(name, "claim", 0, "") == ""

    def answer(self, datagram: bytes | None = None, address: str = "10.0.0.20") -> bytes | None:
        return self.gate.answer(datagram or self.follower.request(), address)

    def answered(self, request: bytes | None = None) -> bytes:
        answer = self.answer(request)
        assert answer is not None
        return answer

    def look(self) -> str:
        self.receive(self.answered())
        return self.follower_admits[-1]

    def expire(self) -> None:
        """Let an expiry pass without an answer."""
        self.now += EXPIRY
        self.follower.tick()

    def told(self) -> dict[str, object]:
        """Return what the answers to the appliances say of followers."""
        found = {}
        for name in BOTH:
            self.number += 1
            body = {"boot": f"nonce {id(self.witness)}", "session": "x", "number": self.number}
            body |= {"do": "look", "epoch": 0}
            answer = self.gate.answer(
                seal(REQUEST, name, APPLIANCES[name].key, body), APPLIANCES[name].address
            )
            assert answer is not None
            found[name] = (unseal(ANSWER, APPLIANCES[name].key, answer) or {})["followers"]
        return found

    def receive(self, datagram: bytes) -> None:
        """Let each of the follower's threads do its part once."""
        self.follower.receive(datagram)
        self.follower.save_epoch()
        self.follower.tick()


def following(holder: str = "a") -> Robot:
    robot = Robot()
    robot.claim(holder)
    assert robot.look() == ""
    assert robot.look() == holder
    return robot


def test_a_follower_admits_what_the_robot_admits() -> None:
    robot = following()
    assert robot.saved == [2]
    robot.claim("b")
    assert robot.look() == "b"
    assert robot.saved == [2, 3]
    assert robot.follower_admits == ["", "a", "b"]


def test_a_follower_never_admits_an_appliance_whose_lease_may_be_over() -> None:
    robot = following()
    request = robot.follower.request()
    robot.now += 0.1
    answer = robot.answered(request)
    robot.now += 0.8
    robot.receive(answer)
    assert robot.follower_admits[-1] == "a"
    robot.now += 0.31
    assert robot.witness.handle("b", "claim", 0, "") == ""
    robot.follower.tick()
    assert robot.follower_admits[-1] == ""


def test_without_answers_both_are_shut_out_after_one_expiry() -> None:
    robot = following()
    robot.expire()
    assert robot.follower_admits == ["", "a", ""]
    assert robot.witness.handle("a", "renew", 2, "b") == ""
    assert robot.look() == "a"


def test_after_a_reboot_of_the_robot_the_follower_waits_as_the_robot_does() -> None:
    robot = following()
    robot.start_witness(robot.witness.record, boot="two")
    robot.look()
    assert robot.look() == ""
    assert robot.witness.handle("a", "renew", 2, "b") == ""
    assert robot.look() == "a"


def test_an_answer_is_used_once_and_only_by_the_process_that_asked() -> None:
    robot = following()
    first, second = robot.answered(), robot.answered()
    robot.claim("b")
    assert robot.look() == "b"
    for old in (first, second):
        robot.receive(old)
        assert robot.follower_admits[-1] == "b"
    request = robot.follower.request()
    robot.start_follower(session="second")
    robot.receive(robot.answered(request))
    assert robot.follower_admits[-1] == ""


def test_an_older_answer_does_not_replace_a_newer_one() -> None:
    robot = following()
    first = robot.answered()
    robot.start_witness(robot.witness.record, boot="two")
    for _ in range(2):
        robot.look()
    assert robot.follower_admits[-1] == ""
    robot.receive(first)
    assert robot.follower_admits[-1] == ""


def test_an_answer_that_was_delayed_for_an_expiry_admits_no_appliance() -> None:
    robot = following()
    answer = robot.answered()
    robot.now += EXPIRY
    robot.receive(answer)
    assert robot.follower_admits[-1] == ""


def test_a_smaller_epoch_is_never_accepted() -> None:
    robot = Robot(epoch=7)
    robot.claim("a")
    robot.look()
    assert robot.look() == ""
    assert "the witness knows only epoch 2" in robot.follower.refusal
    robot.start_follower()
    robot.claim("a")
    for _ in range(2):
        robot.look()
    assert robot.saved == [3]
    robot.start_witness(LeaseRecord(2, "b", BOTH, "one"))
    for _ in range(2):
        robot.look()
    robot.expire()
    assert robot.follower_admits[-1] == "" and "b" not in robot.follower_admits


def test_a_smaller_epoch_is_rejected_whatever_the_witness_says() -> None:
    robot = Robot(epoch=7)
    request = unseal(REQUEST, KEY, robot.follower.request())
    assert request is not None
    lie = {"boot": "", "session": "first", "number": request["number"], "ok": True, "epoch": 6}
    robot.receive(seal(ANSWER, "arm", KEY, lie | {"admitted": "a", "left": 1000}))
    assert robot.follower_admits == [""]
    assert robot.follower.refusal == "the witness has epoch 6, but had 7 before"


def test_an_epoch_that_cannot_be_saved_admits_no_appliance() -> None:
    robot = following()
    robot.claim("b")
    robot.broken = True
    answer = robot.answered()
    with pytest.raises(WitnessError, match="disk is full"):
        robot.receive(answer)
    robot.broken = False
    robot.follower.tick()
    assert robot.follower_admits[-1] == ""
    assert robot.look() == "b"


def test_rules_that_cannot_be_written_are_tried_again() -> None:
    robot = following()
    robot.broken = True
    robot.now += EXPIRY
    with pytest.raises(WitnessError, match="nft: no"):
        robot.follower.tick()
    robot.broken = False
    robot.follower.tick()
    assert robot.follower_admits[-1] == ""
    robot.follower.enforce_again()
    assert robot.follower_admits[-2:] == ["", ""]


@pytest.mark.parametrize("operation", [name for name in OPERATIONS if name != "look"])
def test_a_follower_cannot_change_the_lease(operation: str) -> None:
    robot = following()
    before = robot.witness.record
    robot.now += EXPIRY
    body = {"boot": f"nonce {id(robot.witness)}", "session": "x", "number": 99, "do": operation, "epoch": 2}
    assert robot.answer(seal(REQUEST, "arm", KEY, body)) is None
    for name in BOTH:
        assert robot.answer(seal(REQUEST, name, KEY, body), APPLIANCES[name].address) is None
    assert robot.gate.rejected == 3
    assert robot.witness.record == before
    assert robot.answer(seal(REQUEST, "arm", KEY, body | {"do": "look"}), "10.0.0.21") is None, "its address"


ANSWERED = {"session": "first", "number": 1, "ok": True, "epoch": 2, "admitted": "a", "left": 1000}


@pytest.mark.parametrize(
    "change",
    [
        {"session": "other"},
        {"number": 2},
        {"number": True},
        {"epoch": "2"},
        {"epoch": HIGHEST + 1},
        {"epoch": None},
        {"left": -1},
        {"left": 0.5},
        {"admitted": "c"},
        {"admitted": None},
        {"ok": 1},
        {"ok": False, "reason": "no"},
        {"stale": True, "boot": 1, "last": -1},
    ],
)
def test_a_malformed_answer_changes_nothing(change: dict[str, object]) -> None:
    robot = Robot()
    robot.follower.request()
    robot.receive(seal(ANSWER, "arm", KEY, ANSWERED | change))
    assert robot.follower_admits == [""]
    assert robot.saved == []


@pytest.mark.parametrize("datagram", [b"", b"\x03arm", seal(ANSWER, "arm", b"x" * 32, ANSWERED)])
def test_an_answer_that_is_not_authentic_is_ignored(datagram: bytes) -> None:
    robot = Robot()
    robot.follower.request()
    robot.receive(datagram)
    assert robot.follower_admits == [""]
    robot.receive(seal(ANSWER, "arm", KEY, ANSWERED | {"left": HIGHEST}))
    assert robot.follower_admits == ["", "a"]
    robot.expire()
    assert robot.follower_admits[-1] == "", "an answer counts for one expiry at most"


def test_a_restarted_follower_goes_on_with_the_witnesss_numbers() -> None:
    robot = following()
    for _ in range(20):
        robot.answer()
    robot.start_follower(epoch=2, session="second")
    robot.look()
    assert robot.look() == "a"


def test_a_damaged_epoch_accepts_no_answer(tmp_path: Path) -> None:
    lines: list[str] = []
    log, file = BoundedLog(lines.append, lambda: 0.0), LeaseFile(str(tmp_path / "epoch"), BOTH)
    assert followed_epoch(file, log) == 0
    file.write(LeaseRecord(7, "", BOTH, ""))
    assert followed_epoch(file, log) == 7
    (tmp_path / "epoch").write_bytes(b"damaged")
    robot = Robot(epoch=followed_epoch(file, log))
    assert "systemctl restart rosrv-witness-follow" in lines[0]
    robot.claim("a")
    for _ in range(2):
        assert robot.look() == ""


class RandomHistory:
    """Appliances that come and go, a witness that restarts, a network that loses, delays and repeats, and drift.

    A write of the follower's rules takes about `slow` seconds, in which its other threads go on. It ends at once if
    it is no longer wanted, as the program of the firewall then does, before or after its change: `iptables-restore`
    changes one table after the other.
    """

    def __init__(
        self, seed: int, *, slow: float = 0.0, faults: bool = True, product: ModuleType | None = None
    ) -> None:
        self.random = random.Random(seed)  # noqa: S311  a reproducible history
        self.product = product or delivered_witness()
        self.slow, self.faults, self.asking = slow, faults, True
        self.seconds = 0.0
        self.speeds = [self.random.uniform(0.97, 1.03) for _ in range(2)]
        self.robot_admits = self.follower_admits = ""
        self.writing = False
        self.interrupted = 0
        self.record, self.boot, self.saved = LeaseRecord(1, "", BOTH, ""), 1, 0
        self.up = dict.fromkeys(BOTH, True)
        self.wire: list[tuple[float, bytes, bool]] = []
        self.admitted_seconds = 0.0
        self.start_witness()
        self.start_follower()

    def start_witness(self) -> None:
        self.boot += self.random.random() < 0.3
        self.witness = Witness(
            record=self.record,
            save=lambda record: setattr(self, "record", record),
            admit=lambda name: setattr(self, "robot_admits", name),
            boot=str(self.boot),
            clock=lambda: self.seconds * self.speeds[0],
        )
        self.gate = WitnessGate(self.witness, APPLIANCES, f"{self.random.random()}", FOLLOWERS)

    def start_follower(self) -> None:
        self.follower: Any = None  # it writes its first rules before it asks
        self.follower = self.product.WitnessFollower(
            name="arm", key=KEY, appliances=BOTH, session=f"{self.random.random()}", epoch=self.saved,
            save=lambda epoch: setattr(self, "saved", epoch), admit=self.write,
            clock=lambda: self.seconds * self.speeds[1],
        )  # fmt: skip

    def write(self, name: str, left: Left) -> None:
        end = self.seconds + self.slow * self.random.uniform(0.8, 1.2)
        changed = end - self.random.choice([0, self.random.random() * (end - self.seconds)])
        self.writing = True
        while self.seconds < end:
            if left() <= 0:
                self.writing = False
                raise self.product.UncertainError("the program was ended")
            if changed <= self.seconds:
                self.admit(name)
            self.pass_time()
        self.admit(name)
        self.writing = False

    def admit(self, name: str) -> None:
        assert self.robot_admits in ("", name) or not name, f"after {self.seconds} s {name} is admitted late"
        self.interrupted += bool(self.follower_admits and not name)
        self.follower_admits = name

    def send(self, datagram: bytes, *, answer: bool) -> None:
        chosen = self.random.random() if self.faults else 0.5
        for _ in range(0 if chosen < 0.1 else 2 if chosen > 0.9 else 1):
            delay = self.random.uniform(0, 2) if self.faults and self.random.random() < 0.2 else 0.01
            self.wire.append((self.seconds + delay, datagram, answer))

    def is_time(self, period: float) -> bool:
        """Without faults, appliances and follower ask in time."""
        return (
            self.random.random() < 0.1 if self.faults else round(self.seconds * 50) % round(period * 50) == 0
        )

    def pass_time(self) -> None:
        self.seconds += 0.02
        if self.faults and self.random.random() < 0.03:
            self.up[self.random.choice(BOTH)] ^= True
        if self.faults and self.random.random() < 0.004:
            self.start_witness()
        for name in [one for one in BOTH if self.up[one] and self.is_time(0.3)]:
            other = "b" if name == "a" else "a"
            operation = "renew" if self.record.holder == name else "claim"
            self.witness.handle(name, operation, self.record.epoch, other)
        due = [one for one in self.wire if one[0] <= self.seconds]
        self.wire = [one for one in self.wire if one[0] > self.seconds]
        if self.follower is None or not (self.asking or not self.writing):
            return
        if self.is_time(0.2):
            self.send(self.follower.request(), answer=False)
        for _, datagram, answer in due:
            if answer:
                self.follower.receive(datagram)
            elif (made := self.gate.answer(datagram, "10.0.0.20")) is not None:
                self.send(made, answer=True)
        if self.random.random() < 0.5:
            self.follower.save_epoch()

    def step(self) -> None:
        self.pass_time()
        if self.faults and self.random.random() < 0.002:
            self.start_follower()
        with contextlib.suppress(self.product.UncertainError):
            self.follower.tick()
        both = {self.robot_admits, self.follower_admits} - {""}
        assert len(both) < 2 or self.follower.pause() == 0, f"after {self.seconds} s"
        self.admitted_seconds += 0.02 if self.follower_admits else 0


@pytest.mark.parametrize("slow", [0.0, 0.05, 0.3, 0.9, 1.1, 2.0])
@pytest.mark.parametrize("seed", range(10))
def test_robot_and_follower_never_admit_different_appliances(seed: int, slow: float) -> None:
    history = RandomHistory(seed, slow=slow)
    for _ in range(2_000):
        history.step()
    assert history.record.epoch > 3, "there were takeovers"
    assert history.admitted_seconds > (10 if slow < 0.5 else 0)


@pytest.mark.parametrize("slow", [0.0, 0.1, 0.5, 0.9, 1.1, 1.5, 3.0, 6.0])
def test_a_slow_follower_shuts_out_none_while_the_witness_answers(slow: float) -> None:
    history = RandomHistory(1, slow=slow, faults=False)
    while history.seconds < 120:
        history.step()
    assert history.follower_admits == history.record.holder != ""
    assert history.interrupted == 0


def test_a_follower_that_asks_nothing_while_it_writes_would_never_admit_an_appliance() -> None:
    history = RandomHistory(1, slow=1.5, faults=False)
    history.asking = False
    while history.seconds < 120:
        history.step()
    assert history.admitted_seconds == 0


FOLLOWER_MUTANTS = {
    "rules are written to the end although the lease has ended": (
        "return self._used.until - self._clock() if self._wanted() == name else 0.0",
        "return EXPIRY",
    ),
    "the lease counts from the answer": ("sent + _CONFIDENCE", "self._clock() + _CONFIDENCE"),
    "the lease counts longer than the witness says": ("_CONFIDENCE = 0.9", "_CONFIDENCE = 1.4"),
}


@pytest.mark.parametrize("mutant", FOLLOWER_MUTANTS)
def test_a_history_finds_a_wrong_rule_of_the_follower(mutant: str) -> None:
    product = product_of(Mutant(WITNESS, *FOLLOWER_MUTANTS[mutant], 0)).witness
    with pytest.raises(AssertionError):
        for seed in range(20):
            history = RandomHistory(seed, slow=0.5, product=product)
            for _ in range(2_000):
                history.step()


def test_both_appliances_learn_that_a_follower_interrupts_topics_again_and_again() -> None:
    robot = following()
    for _ in range(3):
        robot.expire()
        assert robot.witness.handle("a", "renew", 2, "b") == ""
        assert robot.look() == "a"
    robot.follower.note("")
    robot.look()
    report = "arm: it shut out both appliances 3 times in a minute"
    assert robot.told() == dict.fromkeys(BOTH, report)
    robot.now += 60
    assert robot.told() == dict.fromkeys(BOTH, ""), "the follower is silent"
    robot.follower.note("")
    robot.look()
    assert robot.told() == dict.fromkeys(BOTH, "")


def test_takeovers_are_not_reported_as_interruptions() -> None:
    robot = following()
    for holder in "baba":
        robot.expire()
        assert robot.follower_admits[-1] == ""
        assert robot.witness.handle(holder, "claim", 0, "") == ""
        robot.look()
        assert robot.look() == holder
    robot.follower.note("")
    assert robot.follower.report == ""


def test_a_report_neither_fills_an_answer_nor_replaces_its_text() -> None:
    robot = following()
    robot.follower.note('\\"\n\u20ac' * 100)
    robot.look()
    assert robot.told() == dict.fromkeys(BOTH, "arm: " + "?" * 155)


def test_an_earlier_version_of_the_witness_gets_no_report() -> None:
    robot = Robot()
    robot.follower.note("the disk is full")
    request = unseal(REQUEST, KEY, robot.follower.request())
    assert request is not None and "report" not in request
    robot.receive(seal(ANSWER, "arm", KEY, ANSWERED | {"number": 1}))
    request = unseal(REQUEST, KEY, robot.follower.request())
    assert request is not None and "report" not in request


# ---- Settings and rules


def written(folder: Path, **changes: object) -> Path:
    path = folder / "witness.json"
    body: dict[str, object] = {
        "listen": "10.0.0.1:7411",
        "fixed": "10.0.0.100",
        "ports": ["11311"],
        "appliances": {name: {"address": appliance.address} for name, appliance in APPLIANCES.items()},
        "followers": {"arm": {"address": "10.0.0.20", "key": KEY.hex()}},
        "follows_as": "arm",
        "state": str(folder / "epoch"),
    }
    path.write_text(json.dumps(body | changes))
    path.chmod(0o600)
    return path


def test_the_settings_of_a_follower_have_only_its_own_key(tmp_path: Path) -> None:
    settings = read_settings(str(written(tmp_path)))
    assert settings.follows_as == "arm"
    assert [appliance.key for appliance in settings.appliances.values()] == [b"", b""]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"follows_as": "leg"}, "the only follower"),
        ({"followers": {}}, "the only follower"),
        ({"followers": {"arm": {"address": "10.0.0.2", "key": KEY.hex()}}}, "different addresses"),
        ({"followers": {"arm": {"address": "10.0.0.1", "key": KEY.hex()}}}, "different addresses"),
        (
            {"followers": {"a": {"address": "10.0.0.20", "key": KEY.hex()}}, "follows_as": "a"},
            "a name and a key",
        ),
        ({"followers": {"arm": {"address": "10.0.0.20"}}}, "'key' is missing"),
        (
            {
                "followers": {
                    f"f{number}": {"address": f"10.0.1.{number}", "key": f"{number:064x}"}
                    for number in range(1, 34)
                },
                "follows_as": "f1",
            },
            "more than 32 followers",
        ),
    ],
)
def test_wrong_settings_of_a_follower_are_rejected(
    tmp_path: Path, changes: dict[str, object], reason: str
) -> None:
    with pytest.raises(WitnessError, match=reason):
        read_settings(str(written(tmp_path, **changes)))


def test_each_computer_has_its_own_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path)
    for command in ("serve", "begin"):
        assert main([command, "--settings", str(path), "--in-sync", "a", "--epoch", "5"]) == 1
        assert "is a command for the computer with the witness" in capsys.readouterr().err
    keys = {name: {"address": one.address, "key": one.key.hex()[:64]} for name, one in APPLIANCES.items()}
    path = written(tmp_path, follows_as="", appliances=keys)
    assert main(["follow", "--settings", str(path)]) == 1
    assert "is a command for a follower" in capsys.readouterr().err
    assert not (tmp_path / "epoch").exists()


def test_requests_pass_only_from_appliances_and_followers(tmp_path: Path) -> None:
    settings = read_settings(str(written(tmp_path)))
    rules = nft_rules(settings, "a")
    assert rules.count('iif "lo" ip daddr 10.0.0.1 udp dport 7411 drop\n        iif "lo" accept') == 1
    assert "ip daddr 10.0.0.1 udp dport 7411 ip saddr != { 10.0.0.2, 10.0.0.3, 10.0.0.20 } drop" in rules
    tag = seal(REQUEST, "arm", KEY, {})[:4].hex()
    assert rules.count("@th,64,32") == 1, "a follower knows no key but its own"
    assert f"ip daddr 10.0.0.1 udp dport 7411 ip saddr 10.0.0.20 @th,64,32 != 0x{tag} drop" in rules
    lines = iptables_rules(settings, "a", {}).splitlines()
    own = [line for line in lines if line.startswith("-A rosrv-witness-in ")]
    assert own[0] == "-A rosrv-witness-in -i lo -d 10.0.0.1 -p udp --dport 7411 -j DROP"
    assert own[-2:] == [
        "-A rosrv-witness-in -s 10.0.0.20 -j RETURN",
        "-A rosrv-witness-in -d 10.0.0.1 -p udp --dport 7411 -j DROP",
    ]
