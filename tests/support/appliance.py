"""The real appliance in a test: `rosrv up` as a user would start it, its audit log, its processes.

with Appliance(host, state, policy=OPEN_POLICY) as appliance:
    ros = RosSession(appliance.master_uri, home, robot)
    assert appliance.audit(decision="deny") == []
"""

import contextlib
import json
import os
import signal
import ssl
import subprocess
import tempfile
import urllib.parse
from pathlib import Path
from typing import Any, Self

from tests.support.command import ROSRV, rosrv
from tests.support.own_namespace import own_namespace
from tests.support.processes import LIMIT, Event, Host, Process, ThisMachine
from tests.support.rest import Rest
from tests.support.waiting import eventually

OPEN_POLICY = """\
[Nodes]
default = *
[Publishers]
default = *
[Subscribers]
default = *
[Commands]
default = *
"""


class Appliance:
    """One running appliance; a context manager."""

    def __init__(
        self,
        host: Host | None = None,
        *,
        policy: str = OPEN_POLICY,
        isolation: str | None = None,
        options: tuple[str, ...] = (),
        json: bool = True,
        relays: int = 1,
    ) -> None:
        """`json` False: as a person starts it; there is no `ready` then, only the lines in `process`.

        `relays` relay processes, on every machine the same.
        """
        self.relays = relays
        self.host: Host = host or ThisMachine()
        self.isolation = isolation or ("none" if isinstance(self.host, ThisMachine) else "container")
        self.options = options
        self.json = json
        # Not pytest's folder: that is closed to the users the appliance's processes run as.
        self.directory = Path(tempfile.mkdtemp(prefix="rosrv-test-"))
        self.directory.chmod(0o755)
        self.state = self.directory / "state"
        self.policy_file = self.directory / "policy.ini"
        self.policy_file.write_text(policy)
        self.process: Process | None = None
        self.ready: Event = {}
        self.token = ""  # the first one, which is said at the first start
        self._looked_at = 0  # the last record that `audit` leaves out
        self._turn = contextlib.ExitStack()  # with isolation netns: until it is closed
        self._has_turn = False

    @property
    def master_uri(self) -> str:
        """Where nodes find their master."""
        return str(self.ready["master"])

    def start(self) -> Self:
        """Start (again, on the same state); returns when nodes may connect."""
        if self.isolation == "netns" and not self._has_turn:
            self._turn.enter_context(own_namespace())
            self._has_turn = True
        loopback = isinstance(self.host, ThisMachine)
        command = [
            ROSRV,
            "up",
            *(["--json"] if self.json else []),
            "--isolation",
            self.isolation,
            "--state",
            str(self.state),
        ]
        command += ["--policy", str(self.policy_file)]
        inside = "0.0.0.0" if self.isolation == "netns" else self.host.address
        command += ["--listen", "127.0.0.1:0" if loopback else f"{inside}:11311"]
        if loopback:
            command += ["--rosmaster-port", "0"]
        command += self.options  # last, for of a flag given twice the second counts
        environment = _environment() | {"ROSRV_RELAYS": str(self.relays)}
        self.process = Process(self.host, command, env=environment, label="rosrv up")
        if self.json:
            self.ready = self.process.wait_for(event="ready", timeout=2 * LIMIT)
            self.token = self.ready.get("token", self.token)
        else:
            self.process.wait_for_text("Nodes may connect", timeout=60)
        return self

    def stop(self) -> int:
        """SIGTERM: the exit status; a clean end takes less than five seconds."""
        return self.process.stop(with_signal=signal.SIGTERM, timeout=10) if self.process else 0

    def rosrv(
        self, *arguments: str, check: bool = True, state: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Another verb of the command, told of this appliance by `--state` (unless it does not take that)."""
        done = rosrv(*arguments, *(["--state", str(self.state)] if state else []))
        if check and done.returncode:
            raise AssertionError(
                f"{' '.join(done.args)}: exit status {done.returncode}\n"
                f"{done.stdout}\n{done.stderr}\n{self.story()}"
            )
        return done

    def status(self) -> dict[str, Any]:
        """`rosrv status --json`, whose exit status says whether something is wrong."""
        status: dict[str, Any] = json.loads(self.rosrv("status", "--json", check=False).stdout)
        return status

    def audit(self, *flags: str, **fields: Any) -> list[dict[str, Any]]:
        """`rosrv audit search --json` with these flags; of its records those that have these fields."""
        lines = self.rosrv("audit", "search", *flags, "--json").stdout.splitlines()
        records: list[dict[str, Any]] = [json.loads(line) for line in lines if line.strip()]
        return [
            record
            for record in records
            if record["sequence"] > self._looked_at
            and all(record.get(key) == value for key, value in fields.items())
        ]

    def leave_out_what_was(self) -> None:
        """From now on `audit` and `recorded` have only what is recorded later: what another test did is not there."""
        self._looked_at = max(
            (record["sequence"] for record in self.audit("--limit", "1")), default=self._looked_at
        )

    def recorded(self, *flags: str, count: int = 1, **fields: Any) -> list[dict[str, Any]]:
        """The same, once there are so many: a record is on disk, and a relay's report at control, a little later."""

        def found() -> list[dict[str, Any]] | None:
            records = self.audit(*flags, **fields)
            return records if len(records) >= count else None

        return eventually(found, lambda: f"{count} records {flags} {fields}\n{self.story()}")

    def reload(self, policy: str) -> None:
        """Write the policy file and have it read again."""
        self.policy_file.write_text(policy)
        self.rosrv("policy", "reload")

    def rest(self, token: str | None = None) -> Rest:
        """REST, by the token given or the first one; trusts the certificate the appliance made."""
        url = str(self.ready["api"])
        certificate = None
        if url.startswith("https:"):
            # The kernel takes connections before the process is there: one answer says that it is.
            place = urllib.parse.urlsplit(url)
            served = ssl.get_server_certificate((str(place.hostname), place.port or 443), timeout=LIMIT)
            certificate = self.state / "api" / "certificate.pem"
            assert certificate.read_text() == served
        return Rest(url, token or self.token, certificate)

    def processes(self) -> dict[str, dict[str, Any]]:
        """The row of each role in `rosrv status`, once every process has said what walls it is in."""

        def told() -> dict[str, dict[str, Any]] | None:
            rows = self.status()["processes"]
            if any(not row["walls"] and row["role"] != "supervisor" for row in rows):
                return None
            return {row["role"]: row for row in rows}

        return eventually(told, self.story)

    def pids(self, role: str) -> list[int]:
        """The process ids of a role, by `rosrv status`."""
        return [row["pid"] for row in self.status()["processes"] if row["role"] == role]

    def kill(self, role: str) -> int:
        """SIGKILL to the (first) process of a role: its id."""
        pid = self.pids(role)[0]
        os.kill(pid, signal.SIGKILL)
        return pid

    def story(self) -> str:
        """What the appliance said, for the message of a failure."""
        return self.process.story() if self.process else "rosrv up was not started"

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop and remove the state."""
        with self._turn:
            self.stop()
        subprocess.run(["/bin/rm", "-rf", str(self.directory)], check=True)


def _environment() -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "ROSRV_"))}
    return kept | {"PYTHONUNBUFFERED": "1"}
