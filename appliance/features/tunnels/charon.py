"""Provision and watch charon over vici, with blocking calls.

Only differences are applied. When a host's certificate is replaced, its tunnel is also closed.
"""

import base64
import contextlib
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

from vici import Session
from vici.exception import CommandException, DeserializationException, EventUnknownException, SessionException

from appliance.channel.messages import TunnelHost, TunnelSeen, TunnelsStated
from appliance.ipsec.strongswan import connection, connection_name, host_of, pool, proposals_of

_Row = dict[str, "bytes | list[bytes] | _Row"]
"""A section of a reply of charon."""

_SECONDS = 10.0
_LISTS = 3  # at most, until a rekeyed tunnel is in one
# vici's own errors, and the errors that its packing raises for a value that is too long.
_FAULTS = (
    CommandException, SessionException, EventUnknownException, DeserializationException, struct.error, OSError,
)  # fmt: skip


class CharonError(Exception):
    """Charon cannot be provisioned; the message gives the reason and the remedy."""


class ViciClient:
    """A client of charon; the methods raise `CharonError`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._session = self._connect()
        self._loaded: dict[str, TunnelHost] = {}
        self._former: dict[str, set[str]] = {}  # by host: the ids of its tunnels with earlier certificates
        self._stated: TunnelsStated | None = None
        self.proposals = proposals_of(self._key_exchanges())

    def close(self) -> None:
        self._session.transport.close()

    def load_key(self, key: bytes) -> None:
        with self._said("the appliance's key"):
            self._session.load_key({"type": "any", "data": key})

    def provision(self, stated: TunnelsStated) -> None:
        """Apply the differences. Revoked tunnels are closed before new ones are loaded."""
        before = self._stated
        if before is None or before.authority != stated.authority:
            with self._said("the authority's certificate"):
                self._session.load_cert({"type": "x509", "flag": "ca", "data": stated.authority})
        if before is None or before.revocations != stated.revocations:
            with self._said("the list of revoked certificates"):
                self._session.load_cert({"type": "x509crl", "data": _der_of(stated.revocations)})
                # charon uses the first valid list that it finds; flush the cache, which may have the old list.
                self._session.flush_certs()
        earlier = dict(self._loaded)
        for name in earlier.keys() - {host.name for host in stated.hosts}:
            self._unload(name)
        own = (stated.address, stated.certificate)
        fresh = before is None or (before.address, before.certificate) != own
        for host in stated.hosts:
            was = earlier.get(host.name)
            if fresh or was != host:
                self._load(host, stated)
            if was is not None and was.serial != host.serial:
                mine = connection_name(host.name)
                self._former[host.name] = {
                    part for name, row in self._standing() if name == mine for part in _parts(row)
                }
                self._close(host.name)
        self._stated = stated

    def list_tunnels(self) -> list[TunnelSeen]:
        """Return the open tunnels. charon's confirmation of a close is not trusted.

        Tunnels of removed hosts, or with a replaced certificate, are closed again: a rekeying during the first close
        can keep such a tunnel open.
        """
        for _ in range(_LISTS):
            found = self._standing()
            if not _hidden_tunnels(found):
                break
        standing = {host for name, _ in found if (host := host_of(name)) is not None}
        for host in sorted(standing - self._loaded.keys()):
            self._close(host)
        for name, row in found:
            former, parts = self._former.get(host_of(name) or ""), _parts(row)
            if former is not None and not former.isdisjoint(parts):
                former |= parts  # a rekeying of the tunnel to end
                self._end(host_of(name), {"ike-id": _text(row, "uniqueid")})
        return [one for name, row in found if (one := _to_tunnel(name, row)) is not None]

    def _standing(self) -> list[tuple[str, _Row]]:
        with self._said("the list of tunnels"):
            return [(name, row) for reply in self._session.list_sas() for name, row in reply.items()]

    def version(self) -> str:
        with self._said("its version"):
            return str(self._session.version()["version"].decode())

    def _key_exchanges(self) -> list[str]:
        with self._said("the list of its algorithms"):
            found = self._session.get_algorithms()
        # Before strongSwan 6 the group was named `dh`.
        return [str(name) for group in ("ke", "dh") for name in found.get(group, {})]

    def listen(self) -> Iterator[tuple[str, bool, str]]:
        """Yield changes of tunnels (host, up, real address), over a separate connection."""
        session = self._connect(timeout=None)
        try:
            for _kind, event in session.listen(["child-updown"]):
                if event is None:
                    continue
                up = event.get("up") == b"yes"
                for name, row in event.items():
                    host = host_of(name) if isinstance(row, dict) else None
                    if host is not None:
                        yield host, up, _text(row, "remote-host")
        except OSError:
            return

    def _load(self, host: TunnelHost, stated: TunnelsStated) -> None:
        with self._said(f"the tunnel of {host.name}"):
            self._session.load_pool(pool(host))
            self._session.load_conn(connection(host, stated, self.proposals))
        self._loaded[host.name] = host

    def _unload(self, name: str) -> None:
        with self._said(f"the end of the tunnel of {name}"):
            self._session.unload_conn({"name": connection_name(name)})
            self._close(name)
            with contextlib.suppress(CommandException):  # the address is in use until the tunnel is closed
                self._session.unload_pool({"name": connection_name(name)})
        del self._loaded[name]
        self._former.pop(name, None)

    def _close(self, name: str) -> None:
        self._end(name, {"ike": connection_name(name)})

    def _end(self, name: str | None, tunnel: dict[str, str]) -> None:
        with self._said(f"the end of the tunnel of {name}"), contextlib.suppress(CommandException):
            # charon reports an error if no tunnel is open.
            list(self._session.terminate({**tunnel, "timeout": "-1", "force": "yes"}))

    def _connect(self, timeout: float | None = _SECONDS) -> Session:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        sock.settimeout(timeout)
        try:
            sock.connect(str(self._path))
        except OSError as error:
            sock.close()
            raise CharonError(f"charon does not answer on {self._path}: {error}") from error
        return Session(sock)

    @contextlib.contextmanager
    def _said(self, what: str) -> Iterator[None]:
        try:
            yield
        except _FAULTS as error:
            raise CharonError(f"charon rejected {what}: {error}") from error


def _der_of(pem: bytes) -> bytes:
    """Return DER, which is a quarter shorter than PEM: vici's limit is 65,535 bytes."""
    return base64.b64decode(b"".join(pem.split(b"-----")[2:3]))


def _hidden_tunnels(found: list[tuple[str, _Row]]) -> set[str]:
    """Return tunnels that a list lacks because their keys were replaced while charon made it."""
    rekeyed = {name for name, row in found if _text(row, "state") == "REKEYED"}
    return rekeyed - {name for name, row in found if _to_tunnel(name, row) is not None}


def _to_tunnel(name: str, row: _Row) -> TunnelSeen | None:
    host = host_of(name)
    if host is None or _text(row, "state") not in ("ESTABLISHED", "REKEYING"):
        return None
    children = [child for child in _carried(row) if _text(child, "state") == "INSTALLED"]
    if not children:
        return None
    return TunnelSeen(
        host,
        _text(row, "remote-host"),
        int(_text(row, "established") or 0),
        sum(int(_text(child, "bytes-in") or 0) for child in children),
        sum(int(_text(child, "bytes-out") or 0) for child in children),
    )


def _carried(row: _Row) -> list[_Row]:
    children = row.get("child-sas")
    return (
        [child for child in children.values() if isinstance(child, dict)]
        if isinstance(children, dict)
        else []
    )


def _parts(row: _Row) -> set[str]:
    """Return the ids of a tunnel, of two kinds; a rekeying changes only one of them."""
    return {
        f"ike {_text(row, 'uniqueid')}",
        *(f"child {_text(child, 'uniqueid')}" for child in _carried(row)),
    }


def _text(row: _Row, key: str) -> str:
    value = row.get(key, b"")
    return value.decode("ascii", "replace") if isinstance(value, bytes) else ""
