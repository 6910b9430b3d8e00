"""Run the supervisor with the real rosmaster and rosout: `program.py STATE [ROLE=ENTRY…]`.

Actors replace the appliance's own processes.
"""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import setproctitle

from appliance.configuration.settings import Settings
from appliance.supervisor import run
from appliance.supervisor.errors import StartError
from appliance.supervisor.isolation_lifecycle import NoIsolation
from appliance.supervisor.logs import configure_logs
from appliance.supervisor.role import Role
from appliance.supervisor.roles import roles_of
from appliance.supervisor.supervisor import ControlReady


class Leaky(NoIsolation):
    probes = True

    def probe(self) -> str | None:
        return "ROSMaster can be reached by another user"


class Interrupted(NoIsolation):
    def __init__(self, when: str) -> None:
        self.when = when

    def build(self) -> None:
        self._interrupt("build")
        _say(event="built")

    def remove(self) -> None:
        self._interrupt("remove")
        _say(event="removed")

    def _interrupt(self, when: str) -> None:
        if when == self.when:
            for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGTERM):
                os.kill(os.getpid(), number)


def main() -> None:
    os.dup2(1, 2)
    setproctitle.setproctitle("rosrv: supervisor")
    configure_logs("supervisor")
    state = Path(sys.argv[1])
    actors = {role: role for role in ("control", "relay", "signer")}
    for one in sys.argv[2:]:
        if one == "leaky":
            mock.patch.object(run, "isolation_for", return_value=Leaky()).start()
            continue
        if one.startswith("interrupted="):
            made = Interrupted(one.partition("=")[2])
            mock.patch.object(run, "isolation_for", return_value=made).start()
            continue
        role, _, entry = one.partition("=")
        actors[role] = entry
    settings = Settings(state=state, listen="127.0.0.1:0", rosmaster_port=0, api="off", isolation="none")
    try:
        run.run_appliance(
            settings,
            tuple(_played(role, actors) for role in roles_of(api=False)),
            _ready,
            node_ports=range(19001, 19101),
        )
    except StartError as error:
        _say(event="refused", reason=str(error))
        sys.exit(1)


def _played(role: Role, actors: dict[str, str]) -> Role:
    if role.name not in actors:
        return role
    return replace(role, entry=f"tests.integration.supervisor.actors:{actors[role.name]}")


def _ready(said: ControlReady, settings: Settings) -> None:
    _say(event="ready", master=said.master, state=str(settings.state))


def _say(**fields: str) -> None:
    os.write(1, (json.dumps(fields) + "\n").encode())  # in one write: the children write there as well


if __name__ == "__main__":
    main()
