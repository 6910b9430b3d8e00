"""Validate the policy and the specifications before `rosrv up` starts anything.

RVMaster reads both again and decides. If an operator loaded a policy or specifications, these survive a restart.
RVMaster then does not read the file or the folder, so the file or the folder may be invalid.
"""

import contextlib
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from appliance.base.actors import DISK
from appliance.base.input_files import read_given_text
from appliance.configuration.settings import Settings
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.policy import DEFAULT_PORTS
from appliance.policy.policy_findings import PolicyError
from appliance.signing.site_keys import read_signature
from appliance.supervisor.errors import StartError
from rosmop.tool.terminal import refused

_STATE = Path("control", "state.db")
_VALID = "valid"


def read_inputs(settings: Settings) -> range:
    """Validate policy and specifications; return the range of ports that the policy file gives to nodes.

    Raises `StartError` with every error of the policy or of the specifications.
    """
    state = settings.state / _STATE
    if settings.monitors is not None and _is_read_at_start(state, "monitor_revision"):
        _require_specifications(settings.monitors, settings.site_keys)
    return read_node_ports(settings)


def read_node_ports(settings: Settings) -> range:
    """Validate the policy; return the range of ports that the policy file gives to nodes.

    Raises `StartError` with every error of the policy.
    """
    try:
        text, signature = _text(settings.policy), read_signature(settings.policy)
        known = PolicyContext(site_keys=settings.site_keys)
        return judge(text, str(settings.policy), known, signature).policy.ports
    except (PolicyError, StartError) as error:
        if not _is_read_at_start(settings.state / _STATE, "policy_revision"):
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
    raise StartError(f"{file}: cannot read the policy: {why}; nothing was started (--policy FILE)")


def _require_specifications(folder: Path, site_keys: Sequence[str]) -> None:
    """Compile in a child process, because this process becomes the supervisor and would keep the compiler's memory."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException), open(writer, "w", encoding="utf-8") as answer:  # noqa: PTH123  a pipe
            answer.write(_errors_in(folder, site_keys) or _VALID)
        os._exit(0)
    os.close(writer)
    with open(reader, encoding="utf-8") as answer:  # noqa: PTH123  as above
        result = answer.read()
    os.waitpid(child, 0)
    if result != _VALID:
        raise StartError(result or f"{folder}: the process that read the specifications exited early")


def _errors_in(folder: Path, site_keys: Sequence[str]) -> str:
    from appliance.specifications.checking import (  # noqa: PLC0415  the compiler: only in this child
        check,
        contents_at_start,
    )
    from appliance.specifications.specification_files import (  # noqa: PLC0415  as above
        SpecificationsRefusedError,
        read_folder,
    )

    try:
        sources = read_folder(folder)
        try:
            check(sources, site_keys)
        except SpecificationsRefusedError as error:
            unbuilt = check(sources, site_keys, compiler=contents_at_start).unbuilt
            refused([*error.findings, f"started without {', '.join(unbuilt)}: rosrv monitor list"])
    except SpecificationsRefusedError as error:
        return "\n".join(error.findings)
    return ""


def _is_read_at_start(state: Path, table: str) -> bool:
    """Whether RVMaster will read the files on disk, rather than a revision that an operator loaded.

    False if unknown: an earlier run may have left statements that are not in the database yet.
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
    return row is None or row[0] == DISK
