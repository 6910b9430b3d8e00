"""The robot's firewall, written by the program `nft` or `iptables`."""

import contextlib
import os
import re
import signal
import subprocess
import threading
import time
from typing import Any, Callable, Dict, List, Optional

from appliance.features.standby.witness.errors import PostponedError, UncertainError, WitnessError
from appliance.features.standby.witness.firewall_rules import (
    CHAINS,
    JUMPS,
    TABLE,
    iptables_rules,
    nft_rules,
    without_iptables_rules,
)
from appliance.features.standby.witness.protocol import Left
from appliance.features.standby.witness.settings import WitnessSettings

_PROGRAM_SECONDS = 20.0  # at a boot, the first rule loads kernel modules from a slow disk
_POLL_SECONDS = 0.05  # between two checks whether a running program is still wanted

Program = Callable[[List[str], str, Left], str]


def always() -> float:
    return _PROGRAM_SECONDS


def run_program(command: List[str], text: str, left: Left = always) -> str:
    """Run a program of the firewall; `left` returns the seconds for which it is still wanted."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}  # type: Dict[str, Any]
    began = time.monotonic()
    try:
        process = subprocess.Popen(command, start_new_session=True, **streams)
    except OSError as error:
        raise WitnessError("%s: %s" % (command[0], error)) from error
    with contextlib.ExitStack() as ended:
        for stream in (process.stdin, process.stdout, process.stderr):
            ended.callback(_close, stream)
        given = text.encode("utf-8")  # type: Optional[bytes]
        while True:
            try:
                done = process.communicate(given, timeout=max(0.0, min(_POLL_SECONDS, left())))
                break
            except subprocess.TimeoutExpired:
                given = None  # it has the input already
            seconds = time.monotonic() - began
            if left() <= 0 or seconds > _PROGRAM_SECONDS:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # also what a script has started
                process.wait()
                raise UncertainError("%s: ended after %.1f s" % (command[0], seconds))
    said, failed = (one.decode("utf-8", "replace") for one in done)  # type: str, str
    if process.returncode:
        failure = WitnessError if process.returncode > 0 else UncertainError  # it was killed
        raise failure("%s: %s" % (command[0], " ".join(failed.split())[:150] or process.returncode))
    return said


def _close(stream: Any) -> None:
    with contextlib.suppress(OSError):  # input that the program did not read
        stream.close()


def chosen_backend(release: str, find: Callable[[str], Optional[str]]) -> str:
    """Return nft or iptables. Before Linux 4.18, translations of nft and iptables exclude one another."""
    version = tuple(int(number) for number in re.findall(r"[0-9]{1,9}", release)[:2])
    if find("nft") and version >= (4, 18):
        return "nft"
    if find("iptables-restore"):
        return "iptables"
    raise WitnessError("neither `nft` nor `iptables` is installed: sudo apt install nftables")


def remove_rules(backend: str, run: Program = run_program) -> None:
    if backend == "nft":
        run(["nft", "-f", "-"], "table ip %s\ndelete table ip %s\n" % (TABLE, TABLE), always)
    else:
        present = run(["iptables-save"], "", always)
        run(["iptables-restore", "--noflush"], without_iptables_rules(present), always)


class LeaseFirewall:
    """The robot's firewall, by `nft` or `iptables`."""

    def __init__(self, settings: WitnessSettings, backend: str, run: Program = run_program) -> None:
        self._settings = settings
        self._backend = backend
        self._run = run
        self._written = None  # type: Optional[List[str]]
        self._rules = 0
        self._restoring = threading.Lock()
        self.waiting = False

    def admit(self, name: str, left: Left = always) -> None:
        """Raise `UncertainError` if the time that is left ends before the rules are in force."""
        before, self._written = self._written, None
        self.waiting = True  # a trial ends, because only one program may have the lock of iptables
        with self._restoring:
            self.waiting = False
            try:
                self._write(name, left)
            except UncertainError:
                raise
            except WitnessError:
                self._written = before
                raise
        with contextlib.suppress(WitnessError):  # unread rules are not intact: they are written again
            self._written = self.present(left)

    def _write(self, name: str, left: Left) -> None:
        if self._backend == "nft":
            self._run(["nft", "-f", "-"], nft_rules(self._settings, name), left)  # changes all rules, or none
            return
        text = iptables_rules(self._settings, name, self._chains(left))
        try:
            self._run(["iptables-restore", "--noflush"], text, left)
        except WitnessError as error:
            raise UncertainError(str(error)) from error  # each table is changed separately
        self._rules = text.count("-A %s-" % CHAINS)

    def try_out(self, name: str) -> None:
        """Let the kernel check the rules that admit an appliance, without a change. A change is not delayed."""
        with self._restoring:
            try:
                if self._backend == "nft":
                    self._run(["nft", "-c", "-f", "-"], nft_rules(self._settings, name), self._unhindered)
                else:
                    text = iptables_rules(self._settings, name, self._chains(self._unhindered))
                    self._run(["iptables-restore", "--test", "--noflush"], text, self._unhindered)
            except UncertainError as error:
                if self.waiting:
                    raise PostponedError(str(error)) from error
                raise

    def _unhindered(self) -> float:
        return 0.0 if self.waiting else _PROGRAM_SECONDS

    @property
    def read(self) -> bool:
        """Whether the rules were read after they were written."""
        return self._written is not None

    def intact(self, present: List[str]) -> bool:
        """Return whether the rules are still those that were written.

        Another program may have changed them before they were first read. So the jumps, which must be first, and the
        number of rules are compared with the written text.
        """
        jumps = ["-A %s -j %s-%s" % (chain, CHAINS, name) for _, rows in JUMPS for chain, name in rows]
        whole = present[: len(jumps)] == jumps and len(present) == len(jumps) + self._rules
        return present == self._written and (whole or self._backend == "nft")

    def _chains(self, left: Left = always) -> Dict[str, List[str]]:
        found, table = {}, ""  # type: Dict[str, List[str]], str
        for line in self._run(["iptables-save"], "", left).splitlines():
            table = line[1:] if line.startswith("*") else table
            if line.startswith("-A "):
                found.setdefault("%s %s" % (table, line.split()[1]), []).append(line)
        return found

    def present(self, left: Left = always) -> List[str]:
        if self._backend == "nft":
            try:
                return [self._run(["nft", "list", "table", "ip", TABLE], "", left)]
            except UncertainError:
                raise
            except WitnessError:
                if "table ip " + TABLE in self._run(["nft", "list", "tables"], "", left).splitlines():
                    raise
                return [""]  # the table is gone
        chains = self._chains(left)
        jumps = [chains.get("%s %s" % (table, chain), [""])[0] for table, rows in JUMPS for chain, _ in rows]
        return jumps + [rule for name in sorted(chains) if CHAINS in name for rule in chains[name]]
