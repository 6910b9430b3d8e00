import functools
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance.channel.admin import AdminAnswer
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Recordings, Trigger
from tests.support.answers import example
from tests.support.bags import make_bag, number
from tests.support.fake_appliance import FakeAppliance
from tests.support.transcript import Section, Transcript, sections

pytestmark = pytest.mark.nightly

BASE = 1_767_225_600


def keep_recordings(fake: FakeAppliance, before: str, how: str = "", *, below: list[str]) -> None:
    """`recordings SECONDS [fleeting]` keeps recordings, each `LETTER BEGAN ENDED {FIELD: VALUE}`, and the memory.

    The id is the letter 20 times; `m` is the memory, with SECONDS of messages, and `o` is still being made. A
    recording has one number a second, the last digit of that second. A fleeting one is removed when the next one is
    fetched.
    """
    known, fetched = dict[str, Recording](), list[str]()
    for line in below:
        letter, began, ended, more = line.split(maxsplit=3)
        times = range(int(began), int(ended) + 1)
        place = Path("state/recordings", letter * 20)
        place.mkdir(parents=True)
        rows = [("/t", "std_msgs/Int32", float(BASE + at), number(at % 10)) for at in times]
        make_bag(place / "recording.bag", rows)
        span = {"began": (BASE + times[0]) * 10**9, "ended": (BASE + times[-1]) * 10**9}
        known[letter * 20] = example(Recording, id=letter * 20, **span, **yaml.safe_load(more))
    memory = known.get("m" * 20)

    def fetch(request: dict[str, Any]) -> AdminAnswer[Any]:
        if how == "fleeting" and fetched:
            shutil.rmtree(Path("state/recordings", fetched[-1]), ignore_errors=True)
        fetched.append(request["id"])
        return AdminAnswer(True, known[request["id"]])

    making = known.get("o" * 20)
    kept = [row for row in known.values() if row not in (memory, making)]
    progress = [OpenRecording(making.id, making.began, making.ended, example(Trigger))] if making else []
    listed = Recordings(kept, ["/*"], ["/secret*", "std_msgs/Char"], float(before), progress)
    fake.decide("recordings", lambda _request: AdminAnswer(True, listed))
    fake.decide("recording fetch", fetch)
    if memory is not None:
        fake.decide("recording memory", lambda _request: AdminAnswer(True, memory))


@pytest.fixture
def transcript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Transcript]:
    monkeypatch.chdir(tmp_path)
    with FakeAppliance() as fake:
        yield Transcript(fake, more={"recordings": functools.partial(keep_recordings, fake)})


@pytest.mark.parametrize("section", sections(*sorted(Path(__file__).parent.glob("*.txt"))))
def test_transcript(transcript: Transcript, section: Section) -> None:
    assert section.played(transcript) == section.text
