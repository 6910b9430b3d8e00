"""Where ESP runs: in the kernel where it has it, else in user space over a TUN device; found out by trying."""

import secrets
import subprocess
from pathlib import Path
from typing import Literal

from appliance.network.namespaces import Namespace, NetworkError

Esp = Literal["kernel", "user space"]
TUN = Path("/dev/net/tun")
_SECONDS = 10.0
# Addresses for documentation (RFC 5737): no packet ever matches the state that is tried.
_STATE = ("src", "192.0.2.1", "dst", "192.0.2.2", "proto", "esp", "spi")


def choose_esp(namespace: Namespace) -> Esp:
    """Where ESP can run in this namespace. Raises `NetworkError` when nowhere, with what to do."""
    refusal = _try_kernel(namespace)
    if refusal is None:
        return "kernel"
    if TUN.exists():
        return "user space"
    raise NetworkError(
        f"no tunnels: the kernel has no ESP ({refusal}), and there is no {TUN} for ESP in user space; load the"
        " kernel module `esp4` or `tun`, or give the container the device: --device /dev/net/tun"
    )


def _try_kernel(namespace: Namespace) -> str | None:
    """Why the kernel does not take a state with the cipher of the tunnels; None when it does."""
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
        return "the program `ip` is not here: apt install iproute2"
    except subprocess.TimeoutExpired:
        return f"`ip` did not answer within {_SECONDS:.0f} seconds"
    return None if done.returncode == 0 else " ".join(done.stderr.split())[:200]
