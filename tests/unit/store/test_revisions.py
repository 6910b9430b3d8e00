from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.unit.store.unconfirmed import Keeper, row

pytestmark = pytest.mark.anyio


async def never(revision: int) -> None:
    raise AssertionError(revision)


def limit(keeper: Keeper) -> dict[str, float | None]:
    return {
        name: keeper.ends.time_left(keeper.unconfirmed, name)
        for name in keeper.ends.names(keeper.unconfirmed)
    }


@pytest.fixture
def keeper(tmp_path: Path) -> Iterator[Keeper]:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    keeper = Keeper(store, ends_of(store, tmp_path), never)
    for number in (4, 5, 7):
        keeper.change(row(number))
    yield keeper
    store.close()


@pytest.mark.nightly
async def test_a_rollback_without_a_number_takes_the_previous_revision(keeper: Keeper) -> None:
    assert await keeper.require(None) == row(5)
    assert await keeper.require(4) == row(4)


@pytest.mark.nightly
@pytest.mark.parametrize(("asked", "said"), [(None, "before this one"), (0, "0"), (6, "6")])
async def test_the_error_names_the_missing_and_the_stored_revisions(
    keeper: Keeper, asked: int | None, said: str
) -> None:
    keeper.in_force = row(4)
    with pytest.raises(LookupError) as caught:
        await keeper.require(asked)
    assert caught.value.args == ([f"there is no revision {said}; kept are: 4, 5, 7"],)


@pytest.mark.nightly
async def test_two_unconfirmed_changes_roll_back_to_the_last_confirmed_one(keeper: Keeper) -> None:
    for number, within in ((8, 300.0), (9, 600.0)):
        keeper.change(row(number), within)
        assert limit(keeper) == {"7": pytest.approx(within, abs=1)}
        assert keeper.confirm_by == pytest.approx(clock.wall() + within, abs=1)
    keeper.change(row(10))
    assert limit(keeper) == {"7": pytest.approx(600.0, abs=1)}
    keeper.change(row(11), settled=True)
    assert (limit(keeper), keeper.confirm_by, keeper.going_back) == ({}, None, None)


@pytest.mark.parametrize(
    ("who", "restarted", "taken"),
    [("eve", False, True), ("eve", True, True), ("disk", True, True), ("disk", False, False)],
)
async def test_only_a_start_of_the_appliance_reads_the_disk_in_place_of_its_revision(
    keeper: Keeper, who: str, restarted: bool, taken: bool
) -> None:
    keeper.change(row(8, who))
    again = Keeper(keeper.store, keeper.ends, never)
    assert again.find_last(restarted=restarted) is taken
    assert again.in_force == row(8, who)


async def test_a_change_that_cannot_go_back_is_tried_again_until_it_has(keeper: Keeper) -> None:
    attempts = list[int]()

    async def back(revision: int) -> None:
        attempts.append(revision)
        if len(attempts) < 3:
            raise StoreError("the disk is full")
        again.change(row(9, "not confirmed in time"), settled=True)
        raise StoreError("the disk is full again")

    again = Keeper(keeper.store, keeper.ends, back)
    again.find_last(restarted=True)
    again.change(row(8), 0.0)
    for _ in range(5):
        keeper.ends.look()
        if again.going_back is not None:
            await again.going_back
    assert (attempts, again.in_force.revision, again.confirm_by) == ([7] * 3, 9, None)
