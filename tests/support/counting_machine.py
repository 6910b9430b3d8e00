"""A virtual machine whose clock counts its instructions, so that no load of its host makes it late.

QEMU executes the instructions in one thread, and skips the time in which the guest only waits (`-icount`). Waiting for
something outside the guest would skip time as well. So its disk is memory, and only the agent runs, without systemd.

QEMU counts one instruction a nanosecond, a tenth of what a usual processor executes. The guest's kernel believes that
its counter is `GIGAHERTZ` times as fast, so its nanosecond has that many instructions. It must not compare the counter
with another clock.
"""

import subprocess
from pathlib import Path

from tests.support.machine import BARE, KERNEL_SETTINGS, Machine
from tests.support.machine_disk import GIGABYTES, Kernel
from tests.support.requirements import need_program

GIGAHERTZ = 8
MEGABYTES = 3072
# The kernel would measure the processor's timer in a loop of GIGAHERTZ times 10^8 instructions, for minutes.
# Timers of the HPET end too early for the guest's clock, and the kernel sets them again.
_CLOCK = f"tsc_early_khz={GIGAHERTZ}000000 tsc=reliable pmtmr=0 nolapic_timer"
# of the disk; each needs the earlier ones
_MODULES = ("nvdimm/libnvdimm", "nvdimm/nd_btt", "nvdimm/nd_pmem", "acpi/nfit/nfit")
_START = f"""\
#!/bin/sh
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
mkdir -p /proc /sys /root
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devtmpfs devtmpfs /dev
modprobe virtio_pci; modprobe virtio_blk
for module in {" ".join(name.rpartition("/")[2] for name in _MODULES)}; do insmod /disk/$module.ko*; done
mount -t ext4 /dev/pmem0 /root
for folder in proc sys dev; do mount -o move /$folder /root/$folder; done
exec run-init /root /bin/sh -c '
mkdir -p /dev/pts /dev/shm /dev/virtio-ports; ln -s vda /dev/vdb
ln -s /proc/self/fd /dev/fd; ln -s fd/0 /dev/stdin; ln -s fd/1 /dev/stdout; ln -s fd/2 /dev/stderr
mount -t devpts devpts /dev/pts
for folder in /dev/shm /run /tmp; do mount -t tmpfs tmpfs $folder; done
mkdir -p /run/lock
hostname rosrv-machine; ip link set lo up
modprobe virtio_console; modprobe virtio_rng
until [ -e "$1" ]; do set -- /dev/vport*p1; sleep 0.1; done
ln -s "$1" /dev/virtio-ports/rosrv.agent
python3 /usr/local/lib/rosrv-agent.py
poweroff --force' </dev/console >/dev/console 2>&1
"""


class CountingMachine(Machine):
    """Its disk keeps nothing that it writes."""

    _has_priority = False
    _power_off = ("poweroff", "--force")

    def __init__(self, directory: Path) -> None:
        super().__init__(directory, processors=1)

    def _choose_accelerator(self, _program: str, _kernel: Kernel) -> str:
        return "tcg"

    def _arguments(self, kernel: Kernel, disk: Path, checkout: Path, port: Path) -> list[str]:
        most = f"{MEGABYTES + 2 * 1024 * GIGABYTES}M"
        return [
            *("-machine", "q35,nvdimm=on", "-accel", "tcg,thread=single", "-icount", "shift=0,sleep=off"),
            *("-cpu", "max", "-smp", str(self.processors), *BARE),
            *("-m", f"{MEGABYTES}M,slots=1,maxmem={most}"),
            *("-kernel", str(kernel.image), "-initrd", str(self._initrd(kernel))),
            *("-append", f"rdinit=/start {KERNEL_SETTINGS} {_CLOCK}"),
            *("-object", f"memory-backend-file,id=disk,share=off,mem-path={disk},size={GIGABYTES}G"),
            *("-device", "nvdimm,memdev=disk"),
            *self._attached(checkout, port),
        ]

    def _initrd(self, kernel: Kernel) -> Path:
        """Return Debian's own, with a second archive that has the start and the modules of the disk."""
        tree, path = self.directory / "initrd", self.directory / "initrd.img"
        (tree / "disk").mkdir(parents=True)
        (tree / "start").write_text(_START)
        (tree / "start").chmod(0o755)
        for name in _MODULES:
            (module,) = (kernel.modules / "kernel" / "drivers").glob(f"{name}.ko*")
            (tree / "disk" / module.name).symlink_to(module)
        names = "\n".join(str(one.relative_to(tree)) for one in sorted(tree.rglob("*")))
        command = [need_program("cpio", "cpio"), "--create", "--format=newc", "--dereference", "--quiet"]
        made = subprocess.run(command, input=names.encode(), cwd=tree, stdout=subprocess.PIPE, check=True)
        first = kernel.initrd.read_bytes()
        path.write_bytes(first + bytes(-len(first) % 4) + made.stdout)
        return path
