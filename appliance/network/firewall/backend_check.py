"""The proof that a back end works here: try it on a port of our own, and see who is refused.

A kernel may accept rules that it never applies (another one is behind the tables, a match extension is a
stub, a container engine filters the calls). So a back end is taken only after a port of ours on loopback
was reached before the rule, refused while the rule names another user, and reached again when it names us,
on IPv4 and IPv6.
"""

import errno
import os
import socket

from appliance.network.firewall.backend import Backend, FirewallError
from appliance.network.firewall.firewall_rules import inner_port
from appliance.network.namespaces import Namespace

_SECONDS = 20.0  # of a slow machine: who is let in or refused is told at once
_LOOPBACK = ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1"))


def prove(backend: Backend, namespace: Namespace) -> None:
    """Install rules for a port of our own, try them, and take them away again.

    Raises: FirewallError, saying what was not enforced; whatever the back end raises.
    """
    own, other = os.geteuid(), os.geteuid() + 1
    try:
        for family, address in _LOOPBACK:
            with namespace.entered():
                server = _listen(family, address)
            if server is None:
                continue  # no such family here, so nothing to protect on it
            with server:
                port = server.getsockname()[1]
                _expect(namespace, server, "before any rule", reached=True)
                backend.install(inner_port("proof", port, "another user", other))
                _expect(namespace, server, f"while a rule of {backend.name} refuses it", reached=False)
                backend.install(inner_port("proof", port, "this user", own))
                _expect(namespace, server, f"while a rule of {backend.name} lets us pass", reached=True)
    finally:
        backend.remove()


def _listen(family: socket.AddressFamily, address: str) -> socket.socket | None:
    try:
        return socket.create_server((address, 0), family=family)
    except OSError as error:
        if error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
            return None
        raise FirewallError(f"cannot listen on {address} to try the firewall: {error.strerror}") from error


def _expect(namespace: Namespace, server: socket.socket, when: str, *, reached: bool) -> None:
    """Connect to `server` from a thread in the namespace."""
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
        raise FirewallError(f"a port of our own on {address[0]} {seen} {when}: it is not enforced here")
