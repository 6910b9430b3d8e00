"""Whether ROSMaster, which knows no lifeline, is alive: it is asked for its process id, as any ROS tool
might.

Only that something comes back is looked at, not what. Where the firewall stands, only connections of
control's user may reach ROSMaster, root's not; the firewall goes by who made the socket, so the socket
is made as that user.
"""

import asyncio
import ctypes
import os
import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

from appliance.supervisor.users import Account

_BODY = (
    b"<?xml version='1.0'?><methodCall><methodName>getPid</methodName><params><param>"
    b"<value><string>/rosrv</string></value></param></params></methodCall>"
)
_REQUEST = (
    b"POST /RPC2 HTTP/1.0\r\nHost: localhost\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n"
    % len(_BODY)
) + _BODY


async def answers(port: int, account: Account, inside: AbstractContextManager[None], seconds: float) -> bool:
    """Whether the ROSMaster on this loopback port answers a call within `seconds`.

    `inside` is entered to be in its network namespace, for as long as it takes to make a socket.
    """
    loop = asyncio.get_running_loop()
    with inside, _as_user(account):
        sock = socket.socket()
    with sock, suppress(OSError, TimeoutError):
        sock.setblocking(False)
        async with asyncio.timeout(seconds):
            await loop.sock_connect(sock, ("127.0.0.1", port))
            await loop.sock_sendall(sock, _REQUEST)
            return await loop.sock_recv(sock, 1) != b""
    return False


@contextmanager
def _as_user(account: Account) -> Iterator[None]:
    # fsuid is what the owner match of the firewall looks at; it belongs to this thread alone (seteuid
    # would, for a moment, take root from the threads that look after the firewall).
    if os.geteuid() != 0:
        yield
        return
    setfsuid = ctypes.CDLL(None).setfsuid
    setfsuid(account.uid)
    try:
        yield
    finally:
        setfsuid(0)
