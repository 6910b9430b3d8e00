import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.fake_appliance import FakeAppliance
from tests.support.features.standby.appliance_pair import four_takeovers, play
from tests.support.transcript import Section, Transcript, sections
from tests.unit.cli.test_transcripts import write_log

pytestmark = pytest.mark.nightly


def write_pair(*, below: list[str]) -> None:
    assert not below
    for member, folder in zip(play(Path("pair"), four_takeovers), ("state", "other"), strict=True):
        shutil.copytree(member.state, folder, dirs_exist_ok=True)


@pytest.fixture
def transcript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Transcript]:
    monkeypatch.chdir(tmp_path)
    with FakeAppliance() as fake:
        yield Transcript(fake, more={"log": write_log, "pair": write_pair})


@pytest.mark.parametrize("section", sections(*sorted(Path(__file__).parent.glob("*.txt"))))
def test_transcript(transcript: Transcript, section: Section) -> None:
    assert section.played(transcript) == section.text
