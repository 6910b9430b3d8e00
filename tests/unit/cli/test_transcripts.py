"""`rosrv` as its users see it: the transcripts (`*.txt`) of this folder; their form: `tests/support/transcript.py`."""

import functools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.channel.admin import AdminAnswer
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Recordings, Trigger
from appliance.network.scan import ScanResult
from rosmop.tests.acting import message
from tests.support.answers import example
from tests.support.appliance_pair import four_takeovers, play
from tests.support.audit import decision, settle
from tests.support.bags import make_bag, number
from tests.support.engines import open_log
from tests.support.fake_appliance import FakeAppliance
from tests.support.transcript import Section, Transcript, sections

pytestmark = pytest.mark.nightly

BASE = 1_767_225_600
"""2026-01-01T00:00:00Z, the beginning of all recordings."""


def write_bag(name: str, md5sum: str | None = None, *, below: list[str]) -> None:
    rows = [line.split(maxsplit=3) for line in below]
    messages = [
        (topic, kind, float(seconds), message(kind, **yaml.safe_load(fields)))
        for seconds, topic, kind, fields in rows
    ]
    make_bag(Path(name), messages, md5sum)


def write_log(signed: str | None = None, *, below: list[str]) -> None:
    """`log [signed]`: an audit log of decisions, each `NUMBER {FIELD: VALUE}`; `signed`: each tenth is a checkpoint."""
    file, key = Path("state/control/audit.db"), Ed25519PrivateKey.generate()
    file.parent.mkdir(exist_ok=True)
    public, logs = key.public_key().public_bytes_raw(), list[AuditLog]()
    log = open_log(
        file,
        checkpoint_every=10 if signed else 1000,
        signer=lambda number, text: (
            logs[0].signed(number, key.sign(text), public) if signed and logs else None
        ),
    )
    logs.append(log)
    for line in below:
        count, _, changes = line.partition(" ")
        for place in range(int(count)):
            log.record(decision(log, place, **yaml.safe_load(changes)))
            assert not signed or settle(log) is None
    assert log.close() is None


def write_pair(*, below: list[str]) -> None:
    assert not below
    for member, folder in zip(play(Path("pair"), four_takeovers), ("state", "other"), strict=True):
        shutil.copytree(member.state, folder, dirs_exist_ok=True)


def keep_recordings(fake: FakeAppliance, before: str, how: str = "", *, below: list[str]) -> None:
    """`recordings SECONDS [fleeting]`: recordings, each `LETTER BEGAN ENDED {FIELD: VALUE}`, and the memory's contents.

    The id is the letter 20 times; `m` is the memory, with SECONDS of messages, and `o` is still being made. A recording
    has one number a second, the last digit of that second. A fleeting one is removed when the next one is fetched.
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


def set_scan(monkeypatch: pytest.MonkeyPatch, *, below: list[str]) -> None:
    found = yaml.safe_load("\n".join(below))
    result = ScanResult(**found | {"open": tuple(found.get("open", ()))})
    monkeypatch.setattr("appliance.cli.protect_verb.scan", lambda *_: result)


@pytest.fixture
def transcript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Transcript]:
    monkeypatch.chdir(tmp_path)
    with FakeAppliance() as fake:
        more: dict[str, Callable[..., None]] = {
            "bag": write_bag,
            "log": write_log,
            "pair": write_pair,
            "recordings": functools.partial(keep_recordings, fake),
            "scan": functools.partial(set_scan, monkeypatch),
        }
        yield Transcript(fake, more=more)


@pytest.mark.parametrize("section", sections(*sorted(Path(__file__).parent.rglob("*.txt"))))
def test_transcript(transcript: Transcript, section: Section) -> None:
    """Each command makes the requests listed below it, and has the output and the exit status listed there."""
    assert section.played(transcript) == section.text
