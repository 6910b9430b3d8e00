import hashlib
from pathlib import Path

import pytest

from appliance.base.age_clock import AgeClock
from appliance.ipsec.signed_checkpoints import CheckpointMemory, CheckpointRefusedError, read_checkpoint
from appliance.ipsec.signer import LARGEST_RECORD, RemovalJudge, RemovalRefusedError, RetentionLimits
from tests.support.aging import DAY, HISTORIES, KEPT, ages_of

LOG = "a" * 32
_DAY = 86_400_000_000_000
_STEP = 100  # records of a checkpoint


class Desk:
    def __init__(self, directory: Path, kept: RetentionLimits) -> None:
        self.now = 1000 * _DAY
        self.signed = CheckpointMemory(directory, clock=lambda: self.now)
        self.removals = RemovalJudge(self.signed, kept, clock=lambda: self.now)
        self.texts: list[bytes] = []
        for _ in range(10):
            self.sign(removed=0)
            self.now += _DAY

    def text(self, *, removed: int | None, time: int = 1, number: int | None = None) -> bytes:
        number = number or len(self.texts) + 1
        previous = hashlib.sha256(self.texts[-1]).hexdigest() if self.texts else "0" * 64
        version, line = (1, "") if removed is None else (2, f"removed {removed}\n")
        return (
            f"rosrv audit checkpoint {version}\nlog {LOG}\nnumber {number}\nsequence {number * _STEP}\n"
            f"hash {'b' * 64}\ntime {time}\nprevious {previous}\n{line}"
        ).encode()

    def sign(self, *, removed: int | None) -> None:
        text = self.text(removed=removed)
        self.signed.accept(text)
        self.texts.append(text)

    def accept(self, number: int) -> str:
        return self.removals.accept(self.texts[number - 1], self.texts[-1]).decode()


def test_records_expire_by_the_signers_clock(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits(days=5))
    text = desk.accept(5)
    assert text.startswith("rosrv audit removal 1\n")
    assert f"checkpoint 5\nsequence {5 * _STEP}\n" in text
    assert text.endswith("limit 5 days\n")
    with pytest.raises(RemovalRefusedError, match="not old enough") as refused:
        desk.accept(7)
    assert refused.value.early


def test_nothing_goes_that_is_kept_for_ever(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits())
    with pytest.raises(RemovalRefusedError, match="kept forever"):
        desk.accept(1)


def test_a_removal_by_size_leaves_enough_records(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits(size=3 * _STEP * LARGEST_RECORD))
    assert desk.accept(7).endswith("bytes\n")
    with pytest.raises(RemovalRefusedError, match="too few came after"):
        desk.accept(8)


def test_an_unsigned_newest_checkpoint_is_ignored(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits(size=3 * _STEP * LARGEST_RECORD))
    with pytest.raises(RemovalRefusedError, match="too few came after"):
        desk.removals.accept(desk.texts[7], desk.text(removed=0, number=1000))


def test_only_signed_checkpoints_allow_a_removal(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits(days=1))
    forged = desk.texts[2].replace(b"b" * 64, b"c" * 64)
    for text in (forged, desk.text(removed=0), desk.texts[0].replace(LOG.encode(), b"d" * 32)):
        with pytest.raises(RemovalRefusedError, match="was not signed here"):
            desk.removals.accept(text, desk.texts[-1])
    with pytest.raises(CheckpointRefusedError, match="not an audit checkpoint"):
        desk.removals.accept(b"", desk.texts[-1])


def test_a_checkpoint_claims_only_approved_removals(tmp_path: Path) -> None:
    desk = Desk(tmp_path, RetentionLimits(days=5))
    with pytest.raises(CheckpointRefusedError, match="only removal up to 0 was approved"):
        desk.sign(removed=_STEP)
    with pytest.raises(CheckpointRefusedError, match="does not state how many records are removed"):
        desk.sign(removed=None)
    desk.accept(3)
    with pytest.raises(CheckpointRefusedError, match="only removal up to 300 was approved"):
        desk.sign(removed=301)
    desk.sign(removed=0)
    desk.sign(removed=300)


def test_a_log_older_than_signed_removals_goes_on(tmp_path: Path) -> None:
    desk = Desk.__new__(Desk)
    desk.now, desk.texts = 1000 * _DAY, []
    desk.signed = CheckpointMemory(tmp_path, clock=lambda: desk.now)
    desk.sign(removed=None)
    desk.sign(removed=None)
    (tmp_path / f"{LOG}.times").unlink()  # it kept none
    desk.sign(removed=150)
    with pytest.raises(CheckpointRefusedError, match="only removal up to 150 was approved"):
        desk.sign(removed=151)
    first, second, third = (desk.signed.signed_at(one) for one in map(read_checkpoint, desk.texts))
    assert (first, second, third) == (1, 1, desk.now)


def test_a_new_log_has_nothing_removed(tmp_path: Path) -> None:
    desk = Desk.__new__(Desk)
    desk.texts = []
    desk.signed = CheckpointMemory(tmp_path, lambda: _DAY)
    with pytest.raises(CheckpointRefusedError, match="only removal up to 0 was approved"):
        desk.sign(removed=7)
    assert not list(tmp_path.iterdir())


class SignedLog:
    """A checkpoint that the signer signed, and whether it would approve the removal of the records up to it."""

    def __init__(self, folder: Path, age: AgeClock) -> None:
        self._signed = CheckpointMemory(folder, age)
        self._removals = RemovalJudge(self._signed, RetentionLimits(days=KEPT / DAY), age, age.true_date)
        head = f"rosrv audit checkpoint 1\nlog {LOG}\nnumber 1\nsequence 9\nhash {'b' * 64}\n"
        self._text = f"{head}time 1\nprevious {'0' * 64}\n".encode()

    def make(self) -> None:
        self._signed.accept(self._text)

    def is_due(self) -> bool:
        try:
            self._removals.accept(self._text, self._text)
        except RemovalRefusedError:
            return False
        return True


@pytest.mark.parametrize("history", HISTORIES)
def test_records_are_kept_for_their_time_whatever_the_clock_does(tmp_path: Path, history: str) -> None:
    assert ages_of(tmp_path, SignedLog, history) == []
