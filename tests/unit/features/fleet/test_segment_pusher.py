import asyncio
import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.proof.copies import signed_checkpoints
from appliance.base.atomic_files import write_whole
from appliance.base.clock import now, using
from appliance.features.fleet import segment_process
from appliance.features.fleet.connection import CollectorConnection, CollectorError
from appliance.features.fleet.segment_process import SegmentPusher
from appliance.formats.receipts import SegmentReceipt
from appliance.signing.log_proof import checkpoint_hash
from tests.support.audit import decision
from tests.support.virtual_clock import VirtualClock
from tests.unit.features.conftest import MakeLog


class Collector(CollectorConnection):
    is_open = True

    def __init__(self, log: Path) -> None:
        self.log = log
        self.key = Ed25519PrivateKey.generate()
        self.pushed: list[int] = []
        self.asked = 0
        self.idle: list[str] = []  # the logs whose robot stated that nothing waits
        self.off: list[str] = []  # those whose robot is switched off
        self.head: Callable[[int], dict[str, Any]] = self.honest_head
        self.changes: dict[str, Any] = {}
        self.refusal: CollectorError | None = None

    def honest_head(self, upto: int) -> dict[str, Any]:
        number = max([one for one in self.pushed if one <= upto], default=0)
        return {"number": number, "hashes": [self.hash_of(number)] if number else []}

    def hash_of(self, number: int) -> str:
        return checkpoint_hash(signed_checkpoints(self.log, number - 1, 1)[0].text())

    def get(self, path: str, longest: int = 0) -> bytes:
        self.asked += 1
        if self.refusal:
            raise self.refusal
        log, _, query = path.removeprefix("v1/logs/").partition("?")
        asked = dict(word.split("=") for word in query.split("&"))
        self.idle += [log] if "idle" in asked else []
        self.off += [log] if "off" in asked else []
        return json.dumps({"robot": "arm1", "log": ""} | self.head(int(asked["upto"]))).encode()

    def put(self, path: str, content: Iterator[bytes], size: int, headers: Any = ()) -> bytes:
        assert sum(map(len, content)) == size
        _v1, _logs, log, _segments, number, name = path.split("/")
        end = signed_checkpoints(self.log, int(number) - 1, 1)[0].sequence
        before = signed_checkpoints(self.log, int(number) - 2, 1)[0].sequence if number != "1" else 0
        self.pushed.append(int(number))
        fields: dict[str, Any] = {"robot": "arm1", "log": log, "number": int(number), "segment": name}
        fields |= {"first": before + 1, "last": end, "time": 1}
        return msgspec.json.encode(SegmentReceipt(**fields | self.changes).sign(self.key))

    def close(self) -> None: ...


@pytest.fixture
def collector(make_log: MakeLog, path: Path) -> Collector:
    log = make_log(checkpoint_every=10)
    for _ in range(3):
        for number in range(10):
            log.record(decision(log, number))
        asyncio.run(asyncio.wait_for(log.wait_signed(), 60))
    return Collector(path)


@pytest.fixture
def make(collector: Collector, path: Path, tmp_path: Path) -> Callable[[], SegmentPusher]:
    (tmp_path / "state").mkdir()
    key = collector.key.public_key().public_bytes_raw()
    return lambda: SegmentPusher(path, tmp_path / "state", collector, key, jitter=lambda: 0.5)


Make = Callable[[], SegmentPusher]


def pushed(pusher: SegmentPusher) -> SegmentPusher:
    """Let it push all that it can."""
    while pusher.step() == 0:
        pass
    return pusher


@pytest.mark.parametrize(
    "number", [10**18, 10**19, 10**400, 4000, -1], ids=["1e18", "1e19", "1e400", "4000", "-1"]
)
def test_a_head_beyond_the_question_is_refused(number: int, collector: Collector, make: Make) -> None:
    collector.head = lambda _upto: {"number": number, "hashes": ["0" * 64]}
    pusher = make()
    assert pusher.step() > 0
    assert pusher.progress.trouble
    assert (collector.asked, collector.pushed, pusher.progress.sequence) == (1, [], 0)


def test_a_head_with_wrong_hashes_ends_the_search(collector: Collector, make: Make) -> None:
    collector.head = lambda upto: {"number": upto, "hashes": ["0" * 64] * 900}
    pusher = make()
    while pusher.step() == 0:
        assert len(collector.pushed) < 100
    assert collector.pushed == sorted(set(collector.pushed))
    assert collector.pushed[0] == 1
    assert collector.asked <= 10


def test_a_head_without_a_receipt_does_not_count(collector: Collector, make: Make) -> None:
    """Retention may rely on a segment only with a signed receipt."""
    newest = signed_checkpoints(collector.log, 0, 100)[-1]
    collector.head = lambda _upto: {"number": newest.number, "hashes": [collector.hash_of(newest.number)]}
    pusher = make()
    collector.changes = {"segment": "0" * 64}
    pusher.step()
    assert (pusher.progress.sent, pusher.progress.sequence) == (0, 0)
    collector.changes = {}
    pushed(pusher)
    assert set(collector.pushed) == {newest.number}
    assert pusher.progress.sequence == newest.sequence


@pytest.mark.parametrize(
    "changes", [{"log": "f" * 32}, {"number": 2}, {"segment": "0" * 64}, {"first": 2}, {"last": 10**30}]
)
def test_a_receipt_for_another_segment_is_refused(
    changes: dict[str, Any], collector: Collector, make: Make, tmp_path: Path
) -> None:
    collector.changes = changes
    pusher = make()
    pusher.step()
    assert "receipt is not for segment 1" in pusher.progress.trouble
    assert (pusher.progress.sent, pusher.progress.sequence) == (0, 0)
    assert [file.name for file in (tmp_path / "state").iterdir()] == ["position.json"]


def test_a_kill_between_receipt_and_position(
    collector: Collector, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receipts = tmp_path / "state" / "receipts.ndjson"

    def killed(*given: Any) -> None:
        if receipts.exists():
            raise SystemExit
        write_whole(*given)

    with monkeypatch.context() as patch:
        patch.setattr(segment_process, "write_whole", killed)
        with pytest.raises(SystemExit):
            make().step()
    receipts.write_bytes(receipts.read_bytes()[:-40])  # and the disk kept a part of the line
    pusher = pushed(make())
    assert collector.pushed[:3] == [1, 1, 2]
    assert pusher.progress.missed == 0
    torn, *lines = receipts.read_bytes().splitlines()
    kept = [msgspec.json.decode(line, type=SegmentReceipt).number for line in lines]
    assert kept == sorted(set(collector.pushed))
    with pytest.raises(msgspec.DecodeError):
        msgspec.json.decode(torn, type=SegmentReceipt)


def test_a_full_disk_is_reported_and_passes(
    collector: Collector, make: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(path: Path, *_rest: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    pusher = make()
    with monkeypatch.context() as patch:
        patch.setattr(segment_process, "write_whole", full)
        assert pusher.step() > 0
    assert "No space left" in pusher.progress.trouble
    assert not (tmp_path / "state" / "segment.gz").exists()
    pushed(pusher)
    assert pusher.progress.trouble == ""
    assert (pusher.progress.missed, pusher.progress.behind) == (0, 0)


def test_a_wait_of_a_year_is_an_hour(collector: Collector, make: Make) -> None:
    """Retry-After must not silence a robot for longer."""
    collector.refusal = CollectorError("later", 503, 365 * 86_400.0)
    assert make().step() == 3600.0


def test_a_replaced_log_counts_from_its_beginning(collector: Collector, make: Make, path: Path) -> None:
    pusher = pushed(make())
    assert pusher.progress.sequence >= 30
    collector.refusal = CollectorError("gone")
    with closing(sqlite3.connect(path)) as log, log:
        log.execute("UPDATE log SET id = ?", ("f" * 32,))
    pusher.step()
    assert "the log was replaced" in pusher.progress.trouble
    assert pusher.progress.sequence == 0


def test_a_checkpoint_that_is_never_signed_is_reported(collector: Collector, make: Make, path: Path) -> None:
    with closing(sqlite3.connect(path)) as log, log:
        log.execute("UPDATE checkpoint SET signature = NULL WHERE number = 2")
    pusher = make()
    assert pusher.step() == 0
    assert pusher.step() > 0
    assert collector.pushed == [1]
    assert "checkpoint 2 is not signed, but later ones are" in pusher.progress.trouble
    with closing(sqlite3.connect(path)) as log, log:
        log.execute("UPDATE checkpoint SET signature = NULL WHERE number > 2")
    assert pusher.step() > 0
    assert pusher.progress.trouble == ""


def test_a_robot_without_records_is_present(collector: Collector, make: Make) -> None:
    pusher = make()
    collector.changes = {"segment": "0" * 64}
    pusher.step()
    assert (pusher.progress.trouble != "", collector.idle) == (True, [])
    collector.changes = {}
    pushed(pusher)
    assert len(collector.idle) == 1
    pusher.step()
    assert len(collector.idle) == 1
    with using(VirtualClock(now=now() + 60)):
        pusher.step()
    assert len(collector.idle) == 2


def test_a_collector_that_lost_segments_gets_them_again(collector: Collector, make: Make) -> None:
    pusher = pushed(make())
    del collector.pushed[1:]
    with using(VirtualClock(now=now() + 60)):
        pusher.step()
        pushed(pusher)
    assert collector.pushed[-2:] == [2, 3]


def test_a_standby_without_a_log_is_present(collector: Collector, make: Make, path: Path) -> None:
    for file in path.parent.glob("audit.db*"):
        file.unlink()
    pusher = make()
    pusher.step()
    assert (pusher.progress.trouble, len(collector.idle)) == ("", 1)
    (path.parent / "state" / "position.json").write_text("{}")
    pusher.step()
    assert "there is no audit log yet" in pusher.progress.trouble


def test_a_robot_that_is_switched_off_reports_it(collector: Collector, make: Make) -> None:
    """The end of the process alone does not mean this: the supervisor may have been killed."""
    pusher = pushed(make())
    pusher.close()
    assert collector.off == []
    pusher.close(stopped=True)
    assert len(collector.off) == 1
    collector.refusal = CollectorError("gone")
    pusher.close(stopped=True)
    assert len(collector.off) == 1


def test_a_robot_whose_log_is_not_collected_does_not_excuse_its_silence(
    collector: Collector, make: Make
) -> None:
    collector.changes = {"segment": "0" * 64}
    pusher = make()
    pusher.step()
    pusher.close(stopped=True)
    assert (pusher.progress.trouble != "", collector.off) == (True, [])
