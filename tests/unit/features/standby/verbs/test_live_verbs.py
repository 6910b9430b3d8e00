import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.admin import AdminAnswer
from appliance.features.standby import live_verbs
from appliance.features.standby.answers import StandbyState
from tests.support.answers import example
from tests.support.command import rosrv
from tests.support.fake_appliance import FakeAppliance

pytestmark = pytest.mark.nightly

BEGINS = "rosrv standby: b is to take over from a\n"
AWAY = AdminAnswer[Any](False, error="RVMaster is being restarted", trouble="failed")


def state(role: str, epoch: int, holder: str) -> AdminAnswer[Any]:
    others = {"other": {"name": "b"}, "witness": {"holder": holder}}
    return AdminAnswer(True, example(StandbyState, name="a", role=role, epoch=epoch, **others))


class Pair:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fake = FakeAppliance()
        self.ordered = 0
        self.answers: list[AdminAnswer[Any]] = []
        self.fake.decide("standby", lambda _request: self._next())
        self.fake.decide("standby promote", lambda _request: self._promoted())
        self.fake.serve(folder)

    def _next(self) -> AdminAnswer[Any]:
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

    def _promoted(self) -> AdminAnswer[Any]:
        self.ordered += 1
        return state("active", 4, "a")

    def promote(self, *options: str) -> tuple[int, str, str]:
        done = rosrv("standby", "switch", *options, ROSRV_STATE=str(self.folder))
        return done.returncode, done.stdout, done.stderr


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    pair = Pair(tmp_path)
    with pair.fake:
        yield pair


def test_it_waits_for_the_other_appliance(pair: Pair) -> None:
    pair.answers = [
        state("active", 4, "a"), state("active", 4, "a"), AWAY, state("standby", 4, ""), state("standby", 5, "b"),
    ]  # fmt: skip
    assert pair.promote() == (0, "b is active, epoch 5\n", BEGINS)
    assert (pair.ordered, len(pair.answers)) == (1, 1)


def test_a_lost_answer_is_not_a_failure(pair: Pair) -> None:
    pair.answers = [state("active", 4, "a"), state("standby", 5, "b")]

    def dies(_request: dict[str, Any]) -> AdminAnswer[Any]:
        pair.ordered += 1
        raise ConnectionResetError

    pair.fake.decide("standby promote", dies)
    status, printed, _errors = pair.promote("--json")
    assert (status, json.loads(printed)["epoch"], pair.ordered) == (0, 5, 1)


def test_a_standby_that_does_not_take_over_is_an_error(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_verbs, "_SWITCH_SECONDS", 0.3)
    pair.answers = [state("active", 4, "a"), state("active", 6, "a")]
    late = "rosrv standby: b is not active after 0.3 s; see: rosrv standby status\n"
    assert pair.promote() == (1, "", BEGINS + late)
