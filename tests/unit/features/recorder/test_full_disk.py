import hashlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from appliance.features.recorder import recorder_link
from appliance.features.recorder.recording_answers import Recording, Trigger
from tests.support.small_disk import small_disk
from tests.unit.features.recorder.test_recorder import SECOND, TEXT, Scene

pytestmark = pytest.mark.nightly


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "recordings", "4m", "nr_inodes=64") as place:
        yield place


@pytest.mark.parametrize("what", ["bytes", "files"])
def test_each_step_on_a_full_disk(disk: Path, tmp_path: Path, what: str) -> None:
    scene = Scene(tmp_path, disk=8 << 20)
    order = Trigger(scene.clock.now, "order", "r", "eve")

    def wanted(number: int) -> recorder_link.RecordingRequested:
        return recorder_link.RecordingRequested(
            number, msgspec.structs.replace(order, time=scene.clock.now + SECOND), 5, 1
        )

    missed = refused = 0
    for number in range(12):
        scene.recorder.step([wanted(number)])
        for step in range(8):
            scene.say(TEXT[:4] + bytes(100_000 if number % 2 else 100))
            if step == number % 8:
                fill(disk, what)
                if number % 3 == 0:
                    scene.begin_anew()
            extra = {3: wanted(100), 5: recorder_link.MemoryWanted(101, wanted(0).trigger, 0, 1 << 62)}
            kept = [
                recorder_link.RecordingNoted(path.name) for path in disk.iterdir() if len(path.name) == 20
            ]
            said = scene.later(0.5, *kept, *([extra[step]] if step in extra else []))
            missed += sum(isinstance(one, recorder_link.RecordingMissed) for one in said)
            refused += sum(isinstance(one, recorder_link.RecordingRefused) for one in said)
        for path in disk.glob("filler*"):
            path.unlink()
        scene.later(1)
        for path in disk.iterdir():
            if len(path.name) == 20 and not (path / "lent").exists():
                found = msgspec.json.decode((path / "recording.json").read_bytes(), type=Recording)
                bag = (path / "recording.bag").read_bytes()
                assert (len(bag), hashlib.sha256(bag).hexdigest()) == (found.size, found.sha256)
                scene.later(0, recorder_link.RecordingRemovalWanted(102, path.name, "eve"))
    assert missed
    assert refused
    scene.recorder.step([wanted(200)])
    assert scene.closed(scene.later(0.5) + scene.later(5))[-1].complete
    scene.log.close()


def fill(disk: Path, what: str) -> None:
    number = 0
    try:
        while True:
            number += 1
            with (disk / f"filler{number}").open("wb", buffering=0) as file:
                while what == "bytes" and file.write(bytes(4096)):
                    pass
    except OSError:
        return
