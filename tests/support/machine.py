"""Run parts of the tests in a virtual machine (QEMU) with Debian's cloud kernel, which ends with this process.

It has no network card. KVM is used if a trial shows that it runs a guest; otherwise QEMU emulates every instruction
(TCG), which is five to twenty times slower.
"""

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from appliance.network.hang_detection import ProcessActivity
from tests.support.machine_disk import ROOT, Kernel, checkout_archive, machine_disk, newest_kernel
from tests.support.requirements import need_program, need_root

BOOT_SECONDS = 900.0  # for a machine that makes progress; waiting for a stalled one ends earlier
_STILL_SECONDS = 60.0  # a halted kernel stops its processors
KVM = Path("/dev/kvm")
MEGABYTES = 2048
BARE = ("-nodefaults", "-no-user-config", "-display", "none", "-no-reboot", "-nic", "none")
# An emulated processor pays for every change of address space. The kernel's defences against other tenants cost more
# than everything else, and there are no other tenants.
# On a busy host the ticks of the emulated timer come too late for the kernel's own test, which ends the boot ("8254
# timer not connected to IO-APIC"). The timer exists, so the test is skipped.
KERNEL_SETTINGS = (
    f"console=ttyS0 panic=-1 quiet rosrv.root={ROOT} no_timer_check mitigations=off nowatchdog audit=0"
)
_TRY_SECONDS = 8.0
_OFF_SECONDS = 180.0
# Programs in an emulated machine have time limits of their own: it gets priority over other processes. Where the kernel
# divides the processors among sessions, the session gets this number as well.
_NICE = "-5"


class MachineError(AssertionError):
    pass


@dataclass(frozen=True)
class Done:
    status: int
    output: str
    seconds: float


class Machine:
    """A virtual machine. `directory` has its sockets and the output of its console.

    It writes to `disk`, or without one works on a snapshot. `freight` writes the archive that the agent unpacks
    before it takes orders; the default is the checkout.
    """

    _has_priority = True
    _power_off: tuple[str, ...] = ("systemd-run", "--quiet", "systemctl", "poweroff")

    def __init__(
        self,
        directory: Path,
        *,
        processors: int = 2,
        disk: Path | None = None,
        freight: Callable[[Path], None] = checkout_archive,
    ) -> None:
        self.directory = directory
        self._own_disk = disk
        self._freight = freight
        self.processors = processors
        self.console = directory / "console.log"
        self.boot_seconds = 0.0
        self.accelerator = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._received = b""
        self._number = 0

    def start(self) -> Self:
        need_root()
        program = need_program("qemu-system-x86_64", "qemu-system-x86")
        kernel = newest_kernel()
        disk = self._own_disk or machine_disk(kernel)
        self.accelerator = self._choose_accelerator(program, kernel)
        checkout = self.directory / "checkout.tar"
        self._freight(checkout)
        port = self.directory / "agent.sock"
        priority = ("nice", f"--adjustment={_NICE}") if self._has_priority else ()
        began = time.monotonic()
        # The death signal is sent when the starting *thread* ends: pytest's fixtures run in the main thread.
        assert threading.current_thread() is threading.main_thread()
        with (self.directory / "qemu.log").open("wb") as log:
            self._process = subprocess.Popen(
                [
                    *("/usr/bin/setpriv", "--pdeathsig=SIGKILL"),
                    *(*priority, program),
                    *self._arguments(kernel, disk, checkout, port),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
                start_new_session=self._has_priority,
                env=os.environ | {"TMPDIR": str(self.directory)},  # of the snapshot
            )
        if self._has_priority:
            with contextlib.suppress(OSError):
                Path(f"/proc/{self._process.pid}/autogroup").write_text(_NICE)
        self._line = self._connect(port)
        assert self._hear(BOOT_SECONDS, still=_STILL_SECONDS) == {"ready": True}
        self.boot_seconds = time.monotonic() - began
        return self

    def run(
        self, *argv: str, seconds: float = 600.0, check: bool = True, patience: float | None = None
    ) -> Done:
        """The program gets `seconds` of the machine's clock; its answer `patience` of this one, 60 more by default."""
        assert self._line is not None, "the machine is not running"
        self._number += 1
        began = time.monotonic()
        self._order(self._number, argv, seconds)
        answer = self._hear(seconds + 60.0 if patience is None else patience)
        assert answer["number"] == self._number
        done = Done(int(answer["status"]), str(answer["output"]), time.monotonic() - began)
        if check and done.status != 0:
            raise MachineError(f"{' '.join(argv)}: status {done.status}\n{done.output}\n{self.story()}")
        return done

    def stop(self) -> bool:
        """Shut down as with the power button, or kill the machine if it does not end. Return True if it shut down."""
        process, self._process = self._process, None
        if process is None:
            return True
        orderly = False
        if process.poll() is None and self._line is not None:
            try:
                self._order(0, self._power_off, 20.0)
                orderly = process.wait(_OFF_SECONDS) == 0
            except (subprocess.TimeoutExpired, OSError):
                os.kill(process.pid, signal.SIGKILL)
        elif process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        process.wait()
        if self._line is not None:
            self._line.close()
            self._line = None
        return orderly

    def _order(self, number: int, argv: Sequence[str], seconds: float) -> None:
        assert self._line is not None
        order = {"number": number, "argv": argv, "seconds": seconds}
        self._line.sendall(json.dumps(order).encode() + b"\n")

    def story(self) -> str:
        words = self.console.read_text(errors="backslashreplace")[-3000:] if self.console.exists() else ""
        log = self.directory / "qemu.log"
        return f"--- the machine's console\n{words}\n--- qemu\n{log.read_text() if log.exists() else ''}"

    def _choose_accelerator(self, program: str, kernel: Kernel) -> str:
        return accelerator(program, kernel)

    def _arguments(self, kernel: Kernel, disk: Path, checkout: Path, port: Path) -> list[str]:
        snapshot = "on" if self._own_disk is None else "off"
        return [
            *_hardware(self.accelerator),
            *("-smp", str(self.processors), "-m", str(MEGABYTES)),
            *("-kernel", str(kernel.image), "-initrd", str(kernel.initrd)),
            *("-append", f"root=/dev/vda rw {KERNEL_SETTINGS} systemd.show_status=0"),
            *("-drive", f"file={disk},if=virtio,format=raw,snapshot={snapshot},cache=unsafe"),
            *self._attached(checkout, port),
        ]

    def _attached(self, checkout: Path, port: Path) -> list[str]:
        return [
            *("-drive", f"file={checkout},if=virtio,format=raw,readonly=on"),
            *("-device", "virtio-rng-pci"),
            *("-device", "virtio-serial-pci"),
            *("-chardev", f"socket,id=agent,path={port},server=on,wait=off"),
            *("-device", "virtserialport,chardev=agent,name=rosrv.agent"),
            *("-serial", f"file:{self.console}"),
        ]

    def _connect(self, path: Path) -> socket.socket:
        assert self._process is not None
        deadline = time.monotonic() + 20
        line = socket.socket(socket.AF_UNIX)
        while True:
            try:
                line.connect(str(path))
            except OSError as error:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise MachineError(f"QEMU did not start: {error}\n{self.story()}") from error
                threading.Event().wait(0.05)
            else:
                return line

    def _hear(self, seconds: float, still: float = math.inf) -> dict[str, Any]:
        assert self._line is not None
        assert self._process is not None
        began, progress = time.monotonic(), ProcessActivity(self._process.pid)
        self._line.settimeout(1.0)
        while b"\n" not in self._received:
            try:
                part = self._line.recv(65536)
            except TimeoutError:
                waited, halted = time.monotonic() - began, progress.stalled_seconds()
                if waited > seconds or halted > still:
                    how = f", and the machine stood still for {halted:.0f} s" if halted > still else ""
                    raise MachineError(f"no answer in {waited:.0f} s{how}\n{self.story()}") from None
                continue
            if not part:
                raise MachineError(f"the machine ended\n{self.story()}")
            self._received += part
        line, _, self._received = self._received.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> Self:
        try:
            return self.start()
        except BaseException:
            self.stop()
            raise

    def __exit__(self, *exc: object) -> None:
        self.stop()


@cache
def accelerator(program: str, kernel: Kernel) -> str:
    """Return `kvm` if a kernel prints its first line with it, otherwise `tcg`: a device file alone proves nothing."""
    if not KVM.exists():
        return "tcg"
    arguments = [*_hardware("kvm"), "-m", "256", "-kernel", str(kernel.image), "-serial", "stdio"]
    # Without a root file system the kernel panics, and the machine ends.
    process = subprocess.Popen(
        [program, *arguments, "-append", "console=ttyS0 earlyprintk=ttyS0 panic=-1"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        said, _ = process.communicate(timeout=_TRY_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        said, _ = process.communicate()
    return "kvm" if b"Linux version" in said else "tcg"


def _hardware(accelerator: str) -> list[str]:
    processor = "host" if accelerator == "kvm" else "max"
    how = "kvm" if accelerator == "kvm" else "tcg,thread=multi"
    return [
        *("-machine", "q35", "-accel", how, "-cpu", processor),
        *BARE,
    ]
