"""Revisions of the specifications as the store keeps them; each with the switches that its monitors had last."""

from collections.abc import Awaitable, Callable, Sequence

import msgspec

from appliance.specifications.rollout import Switch
from appliance.specifications.specification_files import Checked, Sources, SpecificationsRefusedError
from appliance.store.revisions import DISK
from appliance.store.state_file import MonitorRevisionRow, StateStore

Check = Callable[[Sources, Sequence[str]], Awaitable[Checked]]
"""What these are, with the keys of the site. Raises `SpecificationsRefusedError`."""

NOTHING = MonitorRevisionRow(0, "{}", 0.0, DISK, "")
"""Stands for the one before the first."""


class Kept(Sources, frozen=True):
    """A revision as it is in the store; `switches` are those of its monitors when it was replaced."""

    switches: dict[str, Switch] = {}  # noqa: RUF012  each struct gets one of its own


def text_of(sources: Sources) -> str:
    """How they are kept."""
    return msgspec.json.encode(sources).decode()


def kept_in(row: MonitorRevisionRow) -> Kept:
    """What was in force, and how it was switched."""
    return msgspec.json.decode(row.sources, type=Kept)


def sources_of(row: MonitorRevisionRow) -> Sources:
    """What was in force."""
    return msgspec.json.decode(row.sources, type=Sources)


async def check_kept(check: Check, row: MonitorRevisionRow, site_keys: Sequence[str]) -> Checked:
    """Compile what was in force. A newer version of the appliance may refuse it; then there is a way back."""
    try:
        return await check(sources_of(row), site_keys)
    except SpecificationsRefusedError as error:
        way = (
            f"this is revision {row.revision}, which {row.who} brought into force while the appliance ran."
            " To give it up and start with the folder (--monitors): rosrv monitor reset --state DIR"
        )
        raise SpecificationsRefusedError([*error.findings, way]) from error


def forget_revision(store: StateStore, now: float) -> int | None:
    """Have the next start take the folder; the revision that is given up, None if it was the folder's already.

    For an appliance that does not run.
    """
    last = next(iter(store.monitor_revisions(1)), NOTHING)
    if last.who == DISK:
        return None
    note = f"revision {last.revision} was given up"
    store.save_monitor_revision(MonitorRevisionRow(last.revision + 1, "{}", now, DISK, note))
    return last.revision
