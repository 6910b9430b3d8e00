"""Check whether a port is free."""

import errno
import socket
from collections.abc import Sequence

from appliance.network.port_holders import port_holder
from appliance.supervisor.errors import PortInUseError, StartError


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def first_free(ports: range) -> int:
    """Return the first free port that has no old connection either. Raises `OSError`."""
    for port in ports:
        with socket.socket() as sock:
            try:
                sock.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(errno.EADDRINUSE, f"no port from {ports.start} to {ports.stop - 1} is free")


def spare_ports(count: int, taken: Sequence[range], within: range) -> range:
    """Return adjacent ports that do not overlap `taken`. Raises `StartError`."""
    stop = within.stop
    while stop - count >= within.start:
        wanted = range(stop - count, stop)
        in_the_way = [span for span in taken if span.start < wanted.stop and wanted.start < span.stop]
        if not in_the_way:
            return wanted
        stop = min(span.start for span in in_the_way)
    raise StartError(
        f"no {count} neighbouring ports between {within.start} and {within.stop - 1} are left for the appliance's own "
        "node: make [Ports] range in the policy smaller"
    )


def require_free(host: str, port: int) -> None:
    """Raise `StartError` if the port cannot be used, `PortInUseError` with the program that uses it if that is why."""
    if port == 0:
        return
    try:
        family, kind, protocol, _name, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except socket.gaierror as error:
        raise StartError(f"{host!r} is not an address of this machine: {error.strerror}") from error
    with socket.socket(family, kind, protocol) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind(address)
            sock.listen()
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise StartError(
                    f"cannot listen on {host}:{port}: no interface of this machine has {host}; `ip address` lists them"
                ) from error
            if error.errno != errno.EADDRINUSE:
                raise StartError(f"cannot listen on {host}:{port}: {error.strerror}") from error
            raise PortInUseError(
                f"port {port} ({host}) is in use{_by_whom(port)}: stop that program or choose another port"
            ) from error


def _by_whom(port: int) -> str:
    holder = port_holder(port)
    return "" if holder is None else f" by process {holder.pid} ({holder.title})"
