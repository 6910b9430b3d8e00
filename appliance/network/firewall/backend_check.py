"""Test on a loopback port of our own that a back end works on this machine.

A kernel may accept rules that it never applies: a match extension is a stub, or an engine filters the calls.
"""

import errno
import os
import socket

from appliance.network.firewall.backend import Backend, FirewallError
from appliance.network.firewall.firewall_rules import inner_port
from appliance.network.namespaces import Namespace

_SECONDS = 20.0  # enough for a slow machine; usually the answer comes at once
_LOOPBACK = ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1"))


def prove(backend: Backend, namespace: Namespace) -> None:
    """Raise `FirewallError` unless the kernel enforces the rules of this back end."""
    own, other = os.geteuid(), os.geteuid() + 1
    try:
        for family, address in _LOOPBACK:
            with namespace.inside():
                server = _listen(family, address)
            if server is None:
                continue  # the machine lacks this family, so no port needs protection
            with server:
                port = server.getsockname()[1]
                _expect(namespace, server, "before any rule", reached=True)
                backend.install(inner_port("proof", port, "another user", other))
                _expect(namespace, server, f"while a rule of {backend.name} rejects it", reached=False)
                backend.install(inner_port("proof", port, "this user", own))
                _expect(namespace, server, f"while a rule of {backend.name} accepts it", reached=True)
    finally:
        backend.remove()


def _listen(family: socket.AddressFamily, address: str) -> socket.socket | None:
    try:
        return socket.create_server((address, 0), family=family)
    except OSError as error:
        if error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
            return None
        raise FirewallError(f"cannot listen on {address} to test the firewall: {error.strerror}") from error


def _expect(namespace: Namespace, server: socket.socket, when: str, *, reached: bool) -> None:
    """Raise `FirewallError` unless the outcome is as `reached` demands."""
    address = server.getsockname()[:2]

    def connect() -> str | None:
        with socket.socket(server.family, socket.SOCK_STREAM) as client:
            client.settimeout(_SECONDS)
            try:
                client.connect(address)
            except OSError as error:
                return str(error)
        server.accept()[0].close()
        return None

    failure = namespace.run(connect)
    if (failure is None) is not reached:
        seen = "was reached" if failure is None else f"was not reached ({failure})"
        raise FirewallError(f"a test port on {address[0]} {seen} {when}: it is not enforced here")
