"""Validate the policy and the specifications before `rosrv up` starts anything.

RVMaster reads both again. If an operator loaded a policy or monitor, the file or the folder may be invalid.
"""

import contextlib
import ipaddress
import os
import sqlite3
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from appliance.base.actors import DISK
from appliance.base.owner_access import is_named_there
from appliance.configuration.settings import Settings
from appliance.control.assembly.policy_gate import KeptPolicy, policy_at_start
from appliance.control.assembly.robot import robot_addresses
from appliance.control.errors import PolicyRefusedError
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Address
from appliance.policy.policy import DEFAULT_PORTS
from appliance.specifications.specification_files import SpecificationsRefusedError, read_folder, read_usable
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import made_before_0_4
from rosmop.tool.terminal import refusal

_STATE = Path("control", "state.db")
_VALID = "valid"
_NOTHING = "; nothing was started (--policy FILE)"
_LAST_POLICY = """
    SELECT revision, text, file, who, COALESCE(signature, '')
    FROM policy_revision LEFT JOIN policy_signature USING (revision) ORDER BY revision DESC LIMIT 1
"""


def read_inputs(settings: Settings, robot: str | None = None) -> range:
    """Return the range of ports for nodes. Raises `StartError` with every error.

    The standby, which knows the address of the `robot`, starts with the active appliance's policy.
    """
    with contextlib.suppress(OSError):  # if only control can read the state, it judges
        if reason := made_before_0_4(settings.state):
            raise StartError(reason)
    state = settings.state / _STATE
    author = _last_author(state)
    if settings.monitors is not None and author in ("", DISK):
        _require_specifications(settings.monitors, settings.site_keys, kept=author == DISK)
    try:
        return read_node_ports(settings, robot)
    except StartError as error:
        hint = "" if is_named_there(settings.policy) else _NOTHING
        raise StartError(f"{error}{hint}") from None


def read_node_ports(settings: Settings, robot: str | None = None) -> range:
    """Return the range of ports for nodes. Raises `StartError` with every error of the file if no policy is stored."""
    stored = _Stored(None, {}, complete=True)
    state = settings.state / _STATE
    try:
        stored = _stored_in(state)
        known = PolicyContext(stored.hosts, robot_addresses(settings, robot), site_keys=settings.site_keys)
        kept = stored.policy
        first = kept is not None and (kept.who != DISK or robot is not None)
        return policy_at_start(kept, settings.policy, known, kept_first=first).policy.ports
    except PolicyRefusedError as error:
        if not stored.complete or stored.policy is not None:
            return DEFAULT_PORTS  # RVMaster decides; it has the whole state
        raise StartError(str(error)) from None


class _Stored(NamedTuple):
    """The stored policy and hosts. If they are not `complete`, an earlier run left changes outside the database."""

    policy: KeptPolicy | None
    hosts: Mapping[str, Address]
    complete: bool


def _stored_in(state: Path) -> _Stored:
    try:
        if not state.exists():
            return _Stored(None, {}, complete=True)
        complete = not state.with_suffix(".ahead").stat().st_size
        with contextlib.closing(sqlite3.connect(f"file:{state}?mode=ro", uri=True)) as database:
            row = database.execute(_LAST_POLICY).fetchone()
            hosts = database.execute("SELECT name, address FROM host WHERE revoked IS NULL").fetchall()
    except (OSError, sqlite3.Error):
        return _Stored(None, {}, complete=False)
    policy = None if row is None else KeptPolicy(*row)
    return _Stored(policy, {name: ipaddress.ip_address(address) for name, address in hosts}, complete)


def _require_specifications(folder: Path, site_keys: Sequence[str], *, kept: bool) -> None:
    """Raise `StartError` unless a revision is kept, which then stays in force.

    A child process compiles, because the supervisor would keep the compiler's memory.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException), open(writer, "w", encoding="utf-8") as answer:  # noqa: PTH123  a pipe
            answer.write(_errors_in(folder, site_keys, kept=kept) or _VALID)
        os._exit(0)
    os.close(writer)
    with open(reader, encoding="utf-8") as answer:  # noqa: PTH123  as above
        result = answer.read()
    os.waitpid(child, 0)
    if result != _VALID and result and kept:
        refusal([*result.splitlines(), "the specifications that were in force before stay in force"])
    elif result != _VALID:
        raise StartError(result or f"{folder}: the process that read the specifications exited early")


def _errors_in(folder: Path, site_keys: Sequence[str], *, kept: bool) -> str:
    from appliance.specifications.checking import (  # noqa: PLC0415  the compiler: only in this child
        check,
        contents,
        contents_at_start,
    )

    try:
        check(read_folder(folder), site_keys, compiler=partial(contents, at_start=True, lints=False))
        return ""
    except SpecificationsRefusedError as error:
        findings = error.findings
    try:
        sources, unusable = read_usable(folder, site_keys)
        started = check(sources, site_keys, compiler=partial(contents_at_start, lints=False))
    except SpecificationsRefusedError:
        return "\n".join(findings)
    if kept and unusable:
        return "\n".join(findings)
    left_out = [*started.left_out, *unusable]
    unguarded = "; nothing guards the topics of files that cannot be read" if left_out else ""
    refusal(
        [*findings, f"started without {', '.join([*started.unbuilt, *left_out])}{unguarded}: rosrv status"]
    )
    return ""


def _last_author(state: Path) -> str:
    """Return the author of the last specifications; a question mark if changes may not be in the database yet."""
    try:
        if not state.exists():
            return ""
        if state.with_suffix(".ahead").stat().st_size:
            return "?"
        with contextlib.closing(sqlite3.connect(f"file:{state}?mode=ro", uri=True)) as database:
            row = database.execute(
                "SELECT who FROM monitor_revision ORDER BY revision DESC LIMIT 1"
            ).fetchone()
    except (OSError, sqlite3.Error):
        return "?"
    return "" if row is None else str(row[0])
