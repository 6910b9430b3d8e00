"""Check that `rosmaster`, which has no lifeline, is alive: call its `getPid`.

The firewall accepts only sockets of control's user, so the socket is made as this user.
"""

import asyncio
import socket
from contextlib import AbstractContextManager, suppress

from appliance.base.owner_access import acting_as
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
    loop = asyncio.get_running_loop()
    # The firewall matches a socket's owner by fsuid.
    with inside, acting_as(account.uid):
        sock = socket.socket()
    with sock, suppress(OSError, TimeoutError):
        sock.setblocking(False)
        async with asyncio.timeout(seconds):
            await loop.sock_connect(sock, ("127.0.0.1", port))
            await loop.sock_sendall(sock, _REQUEST)
            return await loop.sock_recv(sock, 1) != b""
    return False
