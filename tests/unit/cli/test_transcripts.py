"""Run the transcripts (`*.txt`) here and in the features' folders. `tests/support/transcript.py` defines their form."""

import functools
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.network.scan import ScanResult
from rosmop.tests.acting import message
from tests.support.audit import decision, settle
from tests.support.bags import make_bag
from tests.support.engines import open_log
from tests.support.fake_appliance import FakeAppliance
from tests.support.transcript import Section, Transcript, sections

pytestmark = pytest.mark.nightly


def write_bag(name: str, md5sum: str | None = None, *, below: list[str]) -> None:
    rows = [line.split(maxsplit=3) for line in below]
    messages = [
        (topic, kind, float(seconds), message(kind, **yaml.safe_load(fields)))
        for seconds, topic, kind, fields in rows
    ]
    make_bag(Path(name), messages, md5sum)


def write_log(signed: str | None = None, *, below: list[str]) -> None:
    """`log [signed]` makes an audit log of decisions, each `NUMBER {FIELD: VALUE}`.

    With `signed`, it has a checkpoint for every ten.
    """
    file, key = Path("state/control/audit.db"), Ed25519PrivateKey.generate()
    file.parent.mkdir(exist_ok=True)
    public, logs = key.public_key().public_bytes_raw(), list[AuditLog]()
    log = open_log(
        file,
        checkpoint_every=10 if signed else 1000,
        signer=lambda number, text, **_: (
            logs[0].store_signature(number, key.sign(text), public) if signed and logs else None
        ),
    )
    logs.append(log)
    for line in below:
        count, _, changes = line.partition(" ")
        for place in range(int(count)):
            log.record(decision(log, place, **yaml.safe_load(changes)))
            assert not signed or settle(log) is None
    assert log.close() is None


def set_scan(monkeypatch: pytest.MonkeyPatch, *, below: list[str]) -> None:
    found = yaml.safe_load("\n".join(below))
    result = ScanResult(**found | {"open": tuple(found.get("open", ()))})
    monkeypatch.setattr("appliance.network.scan.scan", lambda *_: result)


@pytest.fixture
def transcript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Transcript]:
    monkeypatch.chdir(tmp_path)
    with FakeAppliance() as fake:
        more: dict[str, Callable[..., None]] = {
            "bag": write_bag,
            "log": write_log,
            "scan": functools.partial(set_scan, monkeypatch),
        }
        yield Transcript(fake, more=more)


_HERE = Path(__file__).parent
_FILES = [*_HERE.rglob("*.txt"), *_HERE.parent.glob("features/*/*.txt")]


@pytest.mark.parametrize("section", sections(*sorted(_FILES)))
def test_transcript(transcript: Transcript, section: Section) -> None:
    assert section.played(transcript) == section.text


_UTC = re.compile(r"[0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]+)?)?Z")
_OTHER = re.compile(r"\$ .*(--json|guard manual)")
"""Commands with other output: JSON, and a document whose digest must be the same in each zone."""
_MARKED = re.compile(r"\(UTC\)|^\S|^ +(2>|->|<-|\{)")


@pytest.mark.parametrize(
    "section", [section for section in sections(*sorted(_FILES)) if _UTC.search(section.values[0].text)]
)
def test_times_for_people_are_in_the_machines_zone(
    transcript: Transcript, monkeypatch: pytest.MonkeyPatch, section: Section
) -> None:
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        played = transcript.play(section.text)
    finally:
        monkeypatch.undo()
        time.tzset()
    outputs = [part for part in re.split(r"^(?=\$ )", played, flags=re.MULTILINE) if not _OTHER.match(part)]
    lines = [line for part in outputs for line in part.splitlines() if not _MARKED.search(line)]
    assert [line for line in lines if _UTC.search(line)] == []
