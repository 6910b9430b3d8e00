"""What `rosrv up` is given to read, read before anything is started or made: the policy and the specifications.

RVMaster reads both again and has the last word. What it would not read is not required here: a policy or specifications
that an operator brought into force while the appliance ran outlast a restart, whatever file and folder have.
"""

import contextlib
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from appliance.base.input_files import read_given_text
from appliance.configuration.settings import Settings
from appliance.policy.judgement import Known, judge
from appliance.policy.policy import DEFAULT_PORTS
from appliance.policy.policy_findings import PolicyError
from appliance.signing.site_keys import read_signature
from appliance.supervisor.errors import StartError

_DISK = "disk"
_IN_ORDER = "in order"


def read_inputs(settings: Settings) -> range:
    """Read them; the ports that the policy's file gives to nodes.

    Raises `StartError` with all that is wrong with the policy, or with the specifications.
    """
    state = settings.state / "control" / "state.db"
    if settings.monitors is not None and _is_read_at_start(state, "monitor_revision"):
        _require_specifications(settings.monitors, settings.site_keys)
    try:
        text, signature = _text(settings.policy), read_signature(settings.policy)
        known = Known(site_keys=settings.site_keys)
        return judge(text, str(settings.policy), known, signature).policy.ports
    except (PolicyError, StartError) as error:
        if not _is_read_at_start(state, "policy_revision"):
            return DEFAULT_PORTS
        if isinstance(error, StartError):
            raise
        raise StartError("\n".join(str(finding) for finding in error.findings)) from None


def _text(file: Path) -> str:
    try:
        return read_given_text(file)
    except OSError as error:
        why = error.strerror
    except UnicodeDecodeError as error:
        why = f"it is not UTF-8 text: {error.reason}"
    raise StartError(f"{file}: the policy cannot be read: {why}; nothing was started (--policy FILE)")


def _require_specifications(folder: Path, site_keys: Sequence[str]) -> None:
    """In a process of its own: this one becomes the supervisor, and what the compiler takes up would stay in it."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException), open(writer, "w", encoding="utf-8") as answer:  # noqa: PTH123  a pipe
            answer.write(_wrong_with(folder, site_keys) or _IN_ORDER)
        os._exit(0)
    os.close(writer)
    with open(reader, encoding="utf-8") as answer:  # noqa: PTH123  as above
        said = answer.read()
    os.waitpid(child, 0)
    if said != _IN_ORDER:
        raise StartError(said or f"{folder}: the specifications were not read: what read them ended")


def _wrong_with(folder: Path, site_keys: Sequence[str]) -> str:
    from appliance.specifications.checking import check  # noqa: PLC0415  the compiler: only in this child
    from appliance.specifications.specification_files import (  # noqa: PLC0415  as above
        SpecificationsRefusedError,
        read_folder,
    )

    try:
        check(read_folder(folder), site_keys)
    except SpecificationsRefusedError as error:
        return "\n".join(error.findings)
    return ""


def _is_read_at_start(state: Path, table: str) -> bool:
    """Whether RVMaster will read what is on disk, and not what an operator brought into force since.

    Not where that cannot be told: statements that an earlier life left beside the database may say otherwise.
    """
    try:
        if not state.exists():
            return True
        if state.with_suffix(".ahead").stat().st_size:
            return False
        with contextlib.closing(sqlite3.connect(f"file:{state}?mode=ro", uri=True)) as database:
            row = database.execute(f"SELECT who FROM {table} ORDER BY revision DESC LIMIT 1").fetchone()  # noqa: S608  one of two names
    except (OSError, sqlite3.Error):
        return False
    return row is None or row[0] == _DISK
