"""Find out where ESP can run: in the kernel, or else in user space over a TUN device."""

import errno
import os
import secrets
import stat
import struct
import subprocess
from pathlib import Path
from typing import Literal

from appliance.network.namespaces import Namespace, NetworkError

Esp = Literal["kernel", "user space"]
TUN = Path("/dev/net/tun")
_SECONDS = 10.0
# Addresses for documentation (RFC 5737): no packet ever matches this state.
_STATE = ("src", "192.0.2.1", "dst", "192.0.2.2", "proto", "esp", "spi")


def choose_esp(namespace: Namespace) -> Esp:
    """Return where ESP can run. Raises `NetworkError` with the remedy."""
    refusal = _try_kernel(namespace)
    if refusal is None:
        return "kernel"
    if TUN.exists():
        return "user space"
    raise NetworkError(
        f"no tunnels: the kernel has no ESP ({refusal}), and there is no {TUN} for ESP in user space; load the"
        " kernel module `esp4` or `tun`, or give the container the device: --device /dev/net/tun"
    )


def lend_tun(uid: int, gid: int, tun: Path | None = None) -> None:
    """Let a user open the TUN device, by its access control list if needed. Raises `NetworkError`."""
    device, shown = tun or TUN, ""
    try:
        about = device.stat()
        mode = stat.S_IMODE(about.st_mode)
        shown = f" (mode {mode:04o})"
        if uid == 0 or mode & 0o006 == 0o006 or (about.st_gid == gid and mode & 0o060 == 0o060):
            return
        os.setxattr(device, _ACL, _with_user(_entries_of(device, mode), uid))
    except OSError as error:
        raise NetworkError(
            f"no tunnels: ESP runs in user space here, and the user {uid} may not open {device}{shown}:"
            f" {error.strerror}; let it: chgrp {gid} {device} && chmod 0660 {device}"
        ) from error


# The kernel's format of an access control list: a version, then each entry's tag, rights and id, sorted by tag.
_ACL, _VERSION, _ENTRY = "system.posix_acl_access", struct.pack("<I", 2), struct.Struct("<HHI")
_OWNER, _USER, _GROUP, _MASK, _OTHER = 1, 2, 4, 0x10, 0x20
_NOBODY, _READ_WRITE = 0xFFFFFFFF, 6


def _entries_of(device: Path, mode: int) -> list[tuple[int, int, int]]:
    try:
        return list(_ENTRY.iter_unpack(os.getxattr(device, _ACL)[len(_VERSION) :]))
    except OSError as error:
        if error.errno != errno.ENODATA:
            raise
    return [(tag, mode >> bits & 7, _NOBODY) for tag, bits in ((_OWNER, 6), (_GROUP, 3), (_OTHER, 0))]


def _with_user(entries: list[tuple[int, int, int]], uid: int) -> bytes:
    """Return the list with a user added; its mask permits the rights of all entries."""
    kept = [row for row in entries if row[0] != _MASK and row[::2] != (_USER, uid)]
    mask = _READ_WRITE
    for tag, rights, _id in kept:
        mask |= rights if tag not in (_OWNER, _OTHER) else 0
    rows = sorted([*kept, (_USER, _READ_WRITE, uid), (_MASK, mask, _NOBODY)], key=lambda row: row[::2])
    return _VERSION + b"".join(_ENTRY.pack(*row) for row in rows)


def _try_kernel(namespace: Namespace) -> str | None:
    spi = f"0x{secrets.randbelow(0x7FFFFFFF) + 0x1000:x}"
    key = "0x" + secrets.token_hex(36)  # 256 bits and the salt
    cipher = ("reqid", "1", "mode", "tunnel", "aead", "rfc4106(gcm(aes))", key, "128")
    refusal = _ip(namespace, ["xfrm", "state", "add", *_STATE, spi, *cipher])
    if refusal is None:
        _ip(namespace, ["xfrm", "state", "delete", *_STATE, spi])
    return refusal


def _ip(namespace: Namespace, arguments: list[str]) -> str | None:
    def call() -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            ["ip", *arguments], capture_output=True, text=True, timeout=_SECONDS, check=False
        )

    try:
        done = namespace.run(call)
    except FileNotFoundError:
        return "the program `ip` is missing: apt install iproute2"
    except subprocess.TimeoutExpired:
        return f"`ip` did not answer within {_SECONDS:.0f} seconds"
    return None if done.returncode == 0 else " ".join(done.stderr.split())[:200]
