"""`rosrv monitor reset`: return a stopped appliance to the folder's specifications."""

import os
from pathlib import Path
from typing import Annotated

import typer

from appliance.base import clock
from appliance.cli.connection.target import DEFAULT_STATE
from appliance.cli.output import Json, say_json, usage_error
from appliance.specifications.specification_revisions import forget_revision
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.supervisor.state_directory import StateDirectory
from rosmop.tool.terminal import refusal, say

_STATE, _VERB = "state.db", "rosrv monitor"


def reset(
    state: Annotated[
        Path, typer.Option(envvar="ROSRV_STATE", help="State directory of the stopped appliance")
    ] = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Discard the specifications that were loaded by command; the next start loads those of the folder.

    Use it if the appliance fails to start with them; for a running appliance use `rosrv monitor reload`. Disabled
    monitors stay disabled. The discarded revision stays in the state directory.

    Example: rosrv monitor reset --state /var/lib/rosrv
    """
    home = state / "control"
    if not (home / _STATE).exists():
        raise usage_error(f"{state} is not a state directory; give the appliance's with --state DIR", _VERB)
    directory = StateDirectory(state)
    try:
        revision = _forget(home)
    finally:
        directory.close()
    if as_json:
        say_json({"given_up": revision})
    elif revision is None:
        say("nothing to discard: the last specifications in force were the folder's")
    else:
        say(
            f"revision {revision} is discarded: the next start loads the specifications of the folder (--monitors)"
        )


def _forget(home: Path) -> int | None:
    owner = home.stat()
    troubles: list[str] = []
    try:
        store = StateStore(home, failed=troubles.append)
        try:
            revision = forget_revision(store, clock.wall())
        finally:
            store.close()
        if troubles:
            raise StoreError(troubles[-1])
        return revision
    except StoreError as error:
        raise refusal([f"{_VERB}: cannot change the state: {error}"]) from error
    finally:
        if os.geteuid() == 0:
            for path in home.glob("state.*"):
                os.chown(path, owner.st_uid, owner.st_gid)
