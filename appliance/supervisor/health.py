"""Whether ROSMaster, which knows no lifeline, is alive: it is asked for its process id, as any ROS tool
might.

Only that something comes back is looked at, not what. Where the firewall stands, only connections of
control's user may reach ROSMaster, root's not; the firewall goes by who made the socket, so the socket
is made as that user.
"""

import asyncio
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from appliance.supervisor.users import Account

_BODY = (
    b"<?xml version='1.0'?><methodCall><methodName>getPid</methodName><params><param>"
    b"<value><string>/rosrv</string></value></param></params></methodCall>"
)
_REQUEST = (
    b"POST /RPC2 HTTP/1.0\r\nHost: localhost\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n"
    % len(_BODY)
) + _BODY


async def answers(port: int, account: Account, seconds: float) -> bool:
    """Whether the ROSMaster on this loopback port answers a call within `seconds`."""
    loop = asyncio.get_running_loop()
    with _socket_of(account) as sock:
        with suppress(OSError, TimeoutError):
            async with asyncio.timeout(seconds):
                await loop.sock_connect(sock, ("127.0.0.1", port))
                await loop.sock_sendall(sock, _REQUEST)
                return await loop.sock_recv(sock, 1) != b""
        return False


def _socket_of(account: Account) -> socket.socket:
    with _effective_user(account):
        sock = socket.socket()
    sock.setblocking(False)
    return sock


@contextmanager
def _effective_user(account: Account) -> Iterator[None]:
    # No await inside: the whole (single-threaded) process is that user meanwhile.
    before = os.geteuid()
    if before == account.uid:
        yield
        return
    os.seteuid(account.uid)
    try:
        yield
    finally:
        os.seteuid(before)
