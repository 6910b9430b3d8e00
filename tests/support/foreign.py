"""Run a command in a user namespace in which this machine's kernel runs programs for arm64, too, by qemu-user-static.

    python tests/support/foreign.py COMMAND …

Root there is root here and may chroot, mount and install, but neither load modules nor make devices. What runs foreign
programs (binfmt_misc) is the namespace's own and gone with it; nothing of the machine is changed. Processes that the
command leaves end with it.
"""

import ctypes
import os
import sys
from pathlib import Path

_NEW_USERS = 0x10000000  # CLONE_NEWUSER
_INSIDE = r"""
mount -t binfmt_misc none /proc/sys/fs/binfmt_misc
magic='\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
mask='\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
printf '%s' ":qemu-aarch64:M::$magic:$mask:/usr/bin/qemu-aarch64-static:OCF" > /proc/sys/fs/binfmt_misc/register
exec "$@"
"""


def main(command: list[str]) -> None:
    """Become the command."""
    left_read, left_write = os.pipe()
    itself, helper = os.getpid(), os.fork()
    if helper == 0:
        # Only who is outside of the new namespace may say that its users are all those of this machine.
        os.close(left_write)
        os.read(left_read, 1)
        for kind in ("uid_map", "gid_map"):
            Path(f"/proc/{itself}/{kind}").write_text("0 0 65536\n")
        os._exit(0)
    if ctypes.CDLL(None, use_errno=True).unshare(_NEW_USERS):
        raise OSError(ctypes.get_errno(), "a user namespace cannot be made")
    os.write(left_write, b".")
    os.waitpid(helper, 0)
    os.execvp("unshare", [  # noqa: S606  the command is the caller's, no shell reads it
        "unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc",
        "sh", "-euc", _INSIDE, "sh", *command,
    ])  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
