from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from appliance.store.writer_thread import StoreError
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase

pytestmark = pytest.mark.anyio


def row(revision: int, who: str = "eve") -> MonitorRevisionRow:
    return MonitorRevisionRow(revision, "{}", float(revision), who, "")


class Keeper(Revisions[MonitorRevisionRow]):
    refusal = outdated = LookupError
    unconfirmed = EndKind("limit")

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends, store.monitor_revisions, store.save_monitor_revision, row(0))

    async def _go_back(self, revision: int) -> None:
        raise AssertionError(revision)

    def change(self, to: MonitorRevisionRow, within: float | None = None) -> None:
        self._put_in_force(to, within)

    def started(self, *, restarted: bool) -> bool:
        return self.find_last(restarted=restarted)

    async def wanted(self, revision: int | None) -> MonitorRevisionRow:
        return await self.wanted(revision)

    def limit(self) -> dict[str, float | None]:
        return {name: self.ends.left(self.unconfirmed, name) for name in self.ends.names(self.unconfirmed)}


@pytest.fixture
def keeper(tmp_path: Path) -> Iterator[Keeper]:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    keeper = Keeper(store, ends_of(store, tmp_path))
    for number in (4, 5, 7):
        keeper.change(row(number))
    yield keeper
    store.close()


@pytest.mark.nightly
async def test_a_rollback_without_a_number_takes_the_previous_revision(keeper: Keeper) -> None:
    assert await keeper.wanted(None) == row(5)
    assert await keeper.wanted(4) == row(4)


@pytest.mark.nightly
@pytest.mark.parametrize(("asked", "said"), [(None, "before this one"), (0, "0"), (6, "6")])
async def test_the_error_names_the_missing_and_the_stored_revisions(
    keeper: Keeper, asked: int | None, said: str
) -> None:
    keeper.in_force = row(4)
    with pytest.raises(LookupError) as caught:
        await keeper.wanted(asked)
    assert caught.value.args == ([f"there is no revision {said}; kept are: 4, 5, 7"],)


@pytest.mark.nightly
async def test_two_unconfirmed_changes_roll_back_to_the_last_confirmed_one(keeper: Keeper) -> None:
    for number, within in ((8, 300.0), (9, 600.0)):
        keeper.change(row(number), within)
        assert keeper.limit() == {"7": pytest.approx(within, abs=1)}
        assert keeper.confirm_by == pytest.approx(clock.wall() + within, abs=1)
    keeper.change(row(10))
    assert (keeper.limit(), keeper.confirm_by, keeper.going_back) == ({}, None, None)


@pytest.mark.parametrize(
    ("who", "restarted", "taken"),
    [("eve", False, True), ("eve", True, True), ("disk", True, True), ("disk", False, False)],
)
async def test_only_a_start_of_the_appliance_reads_the_disk_in_place_of_its_revision(
    keeper: Keeper, who: str, restarted: bool, taken: bool
) -> None:
    keeper.change(row(8, who))
    again = Keeper(keeper.store, keeper.ends)
    assert again.started(restarted=restarted) is taken
    assert again.in_force == row(8, who)


class Returning(Keeper):
    attempts = 0

    async def _go_back(self, revision: int) -> None:
        self.attempts += 1
        if self.attempts < 3:
            raise StoreError("the disk is full")
        self.change(row(9, "not confirmed in time"))
        raise StoreError("the disk is full again")


async def test_a_change_that_cannot_go_back_is_tried_again_until_it_has(keeper: Keeper) -> None:
    again = Returning(keeper.store, keeper.ends)
    again.started(restarted=True)
    again.change(row(8), 0.0)
    for _ in range(5):
        keeper.ends.look()
        if again.going_back is not None:
            await again.going_back
    assert (again.attempts, again.in_force.revision, again.confirm_by) == (3, 9, None)
