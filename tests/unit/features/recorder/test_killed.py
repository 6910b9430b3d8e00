"""A recorder that is killed at any file operation leaves complete recordings, and loses none silently."""

import hashlib
import os
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag2.storage_mcap import McapReader

from appliance.channel import messages
from appliance.features.recorder import recorder_link
from appliance.features.recorder.mcap import as_mcap
from appliance.features.recorder.recording_answers import Recording, Trigger
from tests.unit.features.recorder.test_recorder import BEGAN, SECOND, Scene

pytestmark = pytest.mark.nightly

_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod")
_TOLD = (recorder_link.RecordingClosed, recorder_link.RecordingRemoved)
_KILLED = 9


def _life(scene: Scene) -> None:
    def order() -> Trigger:
        return Trigger(scene.clock.now + SECOND, "order", "r", "eve")

    orders: dict[int, Callable[[], messages.Message]] = {
        0: lambda: recorder_link.RecordingRequested(1, order(), 5, 1),
        3: lambda: recorder_link.MemoryWanted(2, order(), 0, 1 << 62),
        4: lambda: recorder_link.RecordingRemovalWanted(3, kept[0], "eve"),
        5: lambda: recorder_link.RecordingRequested(4, order(), 5, 1),
    }
    kept: list[str] = []
    noted: list[messages.Message] = []
    for number in range(7):
        scene.say()
        answers = scene.later(2, *noted, *([orders[number]()] if number in orders else []))
        noted = [recorder_link.RecordingNoted(one.recording.id) for one in answers if isinstance(one, _TOLD)]
        kept += [recording.id for recording in scene.closed(answers)]


def _killed_at(scene: Scene, operation: int) -> bool:
    child = os.fork()
    if not child:
        done = count(1)

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            changes = event in _CHANGES or (event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR))
            if changes and next(done) == operation:
                os._exit(_KILLED)

        status = 1
        try:
            sys.addaudithook(hook)
            _life(scene)
            status = 0
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, _KILLED)
    return status == _KILLED


def _read_both_ways(bag: Path, target: Path) -> int:
    with Reader(bag) as reader:
        rows = [(one.topic, time, bytes(data)) for one, time, data in reader.messages()]
    target.write_bytes(b"".join(as_mcap(bag)).replace(b"ros1", b"ros2"))
    mcap = McapReader(target)
    mcap.open()
    found = [(one.topic, time, bytes(data)) for one, time, data in mcap.messages(mcap.connections)]
    mcap.close()
    assert sorted(found) == sorted(rows)
    return [row[0] for row in rows].count("/chatter")


@pytest.mark.parametrize("memory", ["same", "another"])
def test_killed_at_each_file_operation(tmp_path: Path, memory: str) -> None:
    removed, kept, chatter = set[int](), set[int](), dict[str, int]()
    for operation in count(1):
        folder = tmp_path / str(operation)
        folder.mkdir()
        scene = Scene(folder, before=30)
        scene.happen()
        killed = _killed_at(scene, operation)
        scene.said += 7
        scene.clock.now = BEGAN + 15 * SECOND
        if memory == "another":
            scene.born = scene.clock.now
        scene.recorder = scene.make_recorder()
        told: list[messages.Message] = []
        for seconds in (0, 20, 20):
            told += scene.later(seconds, recorder_link.RecordingsAsked())
        stated = [one for one in told if isinstance(one, recorder_link.RecordingsStated)][-1].recordings
        gone = {one.recording.id for one in told if isinstance(one, recorder_link.RecordingRemoved)}
        if memory == "same" and 1 not in removed:  # events are in a recording until it is removed
            assert gone or "drop" in {trigger.what for found in stated for trigger in found.triggers}, (
                operation
            )
        names = {path.name for path in scene.folder.iterdir() if not path.name.startswith(".")}
        assert names == {found.id for found in stated}, operation
        for found in stated:
            place = scene.folder / found.id
            assert msgspec.json.decode((place / "recording.json").read_bytes(), type=Recording) == found
            assert hashlib.sha256((place / "recording.bag").read_bytes()).hexdigest() == found.sha256
            if found.sha256 not in chatter:  # equal bags are converted only once
                chatter[found.sha256] = _read_both_ways(place / "recording.bag", folder / "a.mcap")
            assert sum(topic.messages for topic in found.topics) == chatter[found.sha256]
        kept.add(len(stated))
        removed.add(len(gone))
        scene.later(0, *(recorder_link.RecordingNoted(name) for name in names | gone))
        assert {path.name for path in scene.folder.iterdir()} == names, operation
        scene.log.close()
        if not killed:
            break
    assert operation > 20
    assert (removed, kept) == ({0, 1}, {1, 2} if memory == "same" else {0, 1})
