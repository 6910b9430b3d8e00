from pathlib import Path

from appliance.control.links.signer_requests import ReceiptFloor

_ANY = 1 << 63


def floor(folder: Path, *, waits: bool, reserve: int = 1 << 20) -> ReceiptFloor:
    (folder / "control").mkdir()
    return ReceiptFloor(folder, reserve, holding=waits)


def test_it_follows_the_receipts(tmp_path: Path) -> None:
    waiting = floor(tmp_path, waits=True)
    assert waiting.through() == 0
    waiting.received(812)
    assert waiting.through() == 812


def test_without_the_setting_it_allows_any_record(tmp_path: Path) -> None:
    """Reports of the pusher limit nothing unless retention waits."""
    free = floor(tmp_path, waits=False)
    free.received(812)
    assert free.through() == _ANY


def test_on_a_nearly_full_disk_it_allows_any_record(tmp_path: Path) -> None:
    waiting = floor(tmp_path, waits=True, reserve=1 << 60)
    waiting.received(812)
    assert waiting.through() == _ANY
