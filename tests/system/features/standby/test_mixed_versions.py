"""A pair is upgraded, and the state of the later version has a table that the earlier one does not know."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.features.standby.changed_product import changed_product
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import StandbySite
from tests.support.waiting import eventually

_CHANGES = {
    "store/state_file.py": (
        "CREATE TABLE IF NOT EXISTS door (",
        "CREATE TABLE IF NOT EXISTS later (name TEXT PRIMARY KEY) WITHOUT ROWID;\nCREATE TABLE IF NOT EXISTS door (",
    ),
    "features/standby/service_begin.py": (
        "    recorder = await _begin_epoch(control, pair)\n",
        '    store.database.put("later", "row")\n    recorder = await _begin_epoch(control, pair)\n',
    ),
}


@pytest.fixture
def later() -> Iterator[Path]:
    with changed_product(_CHANGES) as folder:
        yield folder


def test_the_earlier_one_of_a_half_upgraded_pair_says_why_it_cannot_follow(
    site: StandbySite, robot: StandbyRobot, later: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def upgrade(name: str) -> None:
        process = site.appliances[name].process
        assert process is not None
        process.stop()
        with monkeypatch.context() as environment:
            environment.setenv("PYTHONPATH", str(later))
            site.start(name)

    def status(name: str) -> tuple[int, str]:
        done = site.appliances[name].rosrv("standby", "status", check=False)
        return done.returncode, " ".join(done.stdout.split())

    site.until_both_in_sync()
    earlier, first = site.pair()
    upgrade(first)
    eventually(lambda: status(earlier)[0] == 0, site.story)
    site.promote(earlier)
    site.until_taken_over(first)
    why = (
        f"the standby {earlier} ({site.appliances[earlier].host.address}) does not follow, because it refuses"
    )
    for name in (first, earlier):
        eventually(lambda name=name: why in status(name)[1], site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default
        seen = {status(name) for _ in range(10)}
        assert all(
            code == 1 and why in text and "the state has no table 'later'" in text for code, text in seen
        )
        assert all(
            f"if the version of {earlier} is older (rosrv --version), upgrade it" in text for _, text in seen
        )
    robot.serves_newcomers()
    upgrade(earlier)
    site.until_both_in_sync()
    eventually(lambda: status(first)[0] == status(earlier)[0] == 0, site.story)
    robot.lost_nothing()
