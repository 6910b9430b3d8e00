"""Keep revisions of the specifications, and choose those of a start."""

import contextlib
from collections.abc import Awaitable, Callable, Collection, Sequence
from typing import NamedTuple

import msgspec

from appliance.base.actors import DISK
from appliance.channel.messages import GivenValue
from appliance.specifications.in_force import unknown_monitors
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationFolder,
    SpecificationsRefusedError,
)
from appliance.specifications.switches import Switch
from appliance.store.ends import EndKind
from appliance.store.state_file import MonitorRevisionRow, StateStore

Check = Callable[[Sources, Sequence[str], Sequence[str] | None], Awaitable[CheckedSpecifications]]
"""Compiles sources, whose warnings are known or None. Raises `SpecificationsRefusedError`."""

CheckBeside = Callable[[Sources, Sequence[str], Sequence[str]], Awaitable[CheckedSpecifications]]
"""Compiles sources; the files named last may still have errors. Raises `SpecificationsRefusedError`."""

MAX_WARNINGS = 100
"""The most warnings that are stored with a revision, or in a record."""

NOTHING = MonitorRevisionRow(0, "{}", 0.0, DISK, "")
"""The revision before the first one."""


UNCONFIRMED_CHANGE = EndKind("confirm monitors")
"""The end of the time to confirm specifications."""


class StartingSpecifications(NamedTuple):
    """The specifications of a start; `refused` has the folder's errors, if the last revision stays in force."""

    sources: Sources
    checked: CheckedSpecifications
    refused: list[str]


class StoredSpecifications(Sources, frozen=True):
    """The sources of a revision; `switches` and `given` are of the time when the revision was replaced.

    `warnings` are those of its load, or None if a start has to look for them.
    """

    switches: dict[str, Switch] = {}  # noqa: RUF012  each struct gets one of its own
    given: dict[str, dict[str, GivenValue]] = {}  # noqa: RUF012  as above
    warnings: tuple[str, ...] | None = None


def text_with_warnings(sources: Sources, checked: CheckedSpecifications) -> str:
    """Return the text of a revision, with its warnings if they are few and each file was compiled."""
    whole = not (checked.unbuilt or checked.left_out) and len(checked.warnings) <= MAX_WARNINGS
    return text_of(
        StoredSpecifications(**msgspec.structs.asdict(sources), warnings=checked.warnings if whole else None)
    )


def text_of(sources: Sources) -> str:
    return msgspec.json.encode(sources).decode()


def kept_in(row: MonitorRevisionRow) -> StoredSpecifications:
    return msgspec.json.decode(row.sources, type=StoredSpecifications)


def sources_of(row: MonitorRevisionRow) -> Sources:
    return msgspec.json.decode(row.sources, type=Sources)


async def specifications_at_start(
    last: MonitorRevisionRow | None,
    folder: SpecificationFolder,
    check: Check,
    site_keys: Sequence[str],
    *,
    named: Collection[str],
    kept: MonitorRevisionRow | None = None,
) -> StartingSpecifications:
    """Return the stored revision `last`, the folder's sources, or `kept` if a reload would refuse the folder.

    Raises `SpecificationsRefusedError`, even if a monitor that is `named` to be enabled is missing.
    """
    refused: list[str] = []
    if last is None:
        sources, checked, refused = await _folder_or_kept(folder, kept, check, site_keys)
    else:
        sources, checked = sources_of(last), await _check_kept(check, last, site_keys)
    if last is None or last.who == DISK:
        checked = _without_unusable(checked, sources, folder, site_keys)
    unknown = sorted(set(named) - checked.monitors.keys())
    if unknown and not checked.left_out and (last is None or last.who == DISK):
        raise SpecificationsRefusedError([f"--enable: {unknown_monitors(unknown, checked)}"])
    return StartingSpecifications(sources, checked, refused)


async def _folder_or_kept(
    folder: SpecificationFolder, kept: MonitorRevisionRow | None, check: Check, site_keys: Sequence[str]
) -> StartingSpecifications:
    sources, checked = None, None
    try:
        sources = folder.read()
        if kept is not None:
            sources = sources.with_topics(sources_of(kept).topics)
        known = kept_in(kept).warnings if kept is not None and sources_of(kept) == sources else None
        checked = await check(sources, site_keys, known)
        findings = [*checked.unbuilt.values(), *checked.left_out.values()]
    except SpecificationsRefusedError as error:
        findings, checked = error.findings, None
    if findings and kept is not None and sources_of(kept) != sources:
        with contextlib.suppress(SpecificationsRefusedError):
            before = await _check_row(check, kept, site_keys)
            if not (before.unbuilt or before.left_out):
                return StartingSpecifications(sources_of(kept), before, findings)
    if sources is None or checked is None:
        try:
            sources, _ = folder.read_usable(site_keys)
            checked = await check(sources, site_keys, None)
        except SpecificationsRefusedError:
            raise SpecificationsRefusedError(findings) from None
    return StartingSpecifications(sources, checked, [])


def _without_unusable(
    checked: CheckedSpecifications, sources: Sources, folder: SpecificationFolder, site_keys: Sequence[str]
) -> CheckedSpecifications:
    """Return the specifications, with the folder's files without a usable text as left out."""
    try:
        _, errors = folder.read_usable(site_keys)
    except SpecificationsRefusedError:
        return checked
    present = sources.by_name()
    unusable = {name: error for name, error in errors.items() if name not in present}
    return msgspec.structs.replace(checked, left_out={**unusable, **checked.left_out})


async def _check_kept(
    check: Check, row: MonitorRevisionRow, site_keys: Sequence[str]
) -> CheckedSpecifications:
    """Check a stored revision; if it is refused, the error names the command that discards it."""
    try:
        return await _check_row(check, row, site_keys)
    except SpecificationsRefusedError as error:
        advice = (
            f"this is revision {row.revision}, loaded by {row.who} while the appliance ran."
            " To discard it and start with the folder (--monitors): rosrv monitor reset --state DIR"
        )
        raise SpecificationsRefusedError([*error.findings, advice]) from error


async def _check_row(
    check: Check, row: MonitorRevisionRow, site_keys: Sequence[str]
) -> CheckedSpecifications:
    return await check(sources_of(row), site_keys, kept_in(row).warnings)


def forget_revision(store: StateStore, now: float) -> int | None:
    """Discard the last revision, and the time to confirm it; return its number.

    Call this only while the appliance is not running.
    """
    last = next(iter(store.monitor_revisions(1)), NOTHING)
    if last.who == DISK:
        return None
    for end in store.ends():
        if end.kind == UNCONFIRMED_CHANGE.name:
            store.forget_end(end.kind, end.name)
    note = f"revision {last.revision} was discarded"
    store.save_monitor_revision(MonitorRevisionRow(last.revision + 1, "{}", now, DISK, note))
    return last.revision
