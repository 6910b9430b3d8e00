"""A host that joins the appliance with its kit: the unpacked files and its own charon, in the host's namespace.

The kit's own `join.sh` needs a machine with systemd; here the same strongSwan gets the same files.
"""

import os
import re
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from appliance.ipsec.strongswan import plugins
from appliance.network.esp import choose_esp
from examples.landshark.lab import Host
from tests.support.processes import LIMIT, Event, Process
from tests.support.requirements import need_program

_CONFIGURATION = """\
charon-systemd {{
  load = {plugins}
  plugins {{
    vici {{
      socket = unix://{directory}/vici.sock
    }}
  }}
  filelog {{
    output {{
      path = /dev/stdout
      default = 1
      {log}
      flush_line = yes
    }}
  }}
}}
"""


def need_strongswan() -> None:
    need_program("charon-systemd", "charon-systemd libcharon-extra-plugins")
    need_program("swanctl", "strongswan-swanctl")
    need_program("ping", "iputils-ping")


class JoinedHost:
    def __init__(
        self,
        host: Host,
        kit: Path,
        directory: Path,
        *,
        log: str = "",
        programs: Path | None = None,
    ) -> None:
        """Unpack the kit into the new folder `directory`. `log` is added to charon's log settings (`chd = 4`).

        Programs in `programs` are found first.
        """
        self.outer = host
        self.log = log
        self.path = os.environ["PATH"] if programs is None else f"{programs}:{os.environ['PATH']}"
        self.directory = directory
        directory.mkdir()
        subprocess.run(["tar", "-xzf", str(kit), "-C", str(directory)], check=True)
        (self.folder,) = directory.iterdir()
        readme = (self.folder / "README").read_text()
        self.master = readme.split("ROS_MASTER_URI=")[1].split()[0]
        self.address = readme.split("ROS_IP=")[1].split()[0]
        self.charon: Process | None = None
        self.keeper: Process | None = None

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        return self.outer.popen(args, **options)

    def start(self) -> Self:
        conf = self.directory / "strongswan.conf"
        text = _CONFIGURATION.format(
            plugins=plugins(choose_esp(self.outer.namespace)),
            directory=self.directory,
            log=self.log,
        )
        conf.write_text(text)
        environment = {"STRONGSWAN_CONF": str(conf), "PATH": self.path}
        self.charon = Process(
            self.outer, ["charon-systemd"], env=environment, label=f"charon of {self.outer.name}"
        )
        self.charon.wait_for(lambda event: "spawning" in str(event.get("text")))
        done = self.outer.popen(
            ["swanctl", "--load-all", "--noprompt", "--uri", f"unix://{self.directory}/vici.sock"],
            env=environment | {"SWANCTL_DIR": str(self.folder / "swanctl")},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        out, _ = done.communicate(timeout=LIMIT)
        assert done.returncode == 0, f"swanctl: {out}\n{self.charon.story()}"
        command = [str(self.folder / "keep.sh"), "--uri", f"unix://{self.directory}/vici.sock"]
        self.keeper = Process(self.outer, command, env=environment, label="keep.sh")
        return self

    def wait_until_up(self, since: int = 0) -> None:
        assert self.charon is not None
        self.charon.wait_for(
            lambda event: (
                "CHILD_SA ros" in str(event.get("text")) and "established" in str(event.get("text"))
            ),
            since=since,
            timeout=2 * LIMIT,
        )

    def wait_until_replaced(self) -> None:
        assert self.charon is not None
        first = self.charon.wait_for(lambda event: _established(event) is not None)
        self.charon.wait_for_text(f"vici terminate IKE_SA #{_established(first)}")

    def events(self) -> int:
        assert self.charon is not None
        return len(self.charon.events)

    def wait_until_refused(self, since: int = 0) -> None:
        assert self.charon is not None
        self.charon.wait_for(
            lambda event: (
                re.search("received (AUTHENTICATION_FAILED|NO_PROPOSAL_CHOSEN)", str(event.get("text")))
                is not None
            ),
            since=since,
            timeout=2 * LIMIT,
        )

    def stop(self) -> None:
        if self.keeper is not None:
            self.keeper.kill()
            self.keeper.stop()
            self.keeper = None
        if self.charon is not None:
            self.charon.stop(with_signal=signal.SIGTERM)
            self.charon = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()


def _established(event: Event) -> str | None:
    match = re.search(r"IKE_SA rosrv\S*\[(\d+)\] established", str(event.get("text")))
    return match and match[1]
