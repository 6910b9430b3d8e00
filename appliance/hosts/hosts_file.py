"""`ipsec/hosts.yaml`: the hosts that are meant to be enrolled. Read at start and on reload, never written.

hosts:
  - name: ocu-1
    address: 10.113.11.20   # optional: kept for it
    groups: [operators]     # optional
    tunnel: true            # false: enrolled or not, its tunnel stays closed

A file that cannot be understood changes nothing: what was read before holds, and the status says so.
"""

import re
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated

import msgspec
import yaml
from msgspec import Meta, Struct

_LARGEST = 1 << 20


class DeclaredHostsError(Exception):
    """The file cannot be understood; the text says where and why."""


@dataclass(frozen=True)
class DeclaredHost:
    """A host that is meant to be enrolled; `wanted`: its tunnel may be open."""

    name: str
    address: str | None
    groups: tuple[str, ...] = ()
    wanted: bool = True


class Declared:
    """What the file said when it was last understood; `error` says why it is not what the file says now."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.hosts: dict[str, DeclaredHost] = {}
        self.error = ""
        try:
            self.hosts = read_declared(path)
        except DeclaredHostsError as error:
            self.error = str(error)

    @property
    def there(self) -> bool:
        """Whether anything is declared: without that nothing diverges from it."""
        return bool(self.hosts)

    def reload(self) -> None:
        """Read the file again. Raises `DeclaredHostsError`; what was read before holds then."""
        try:
            self.hosts = read_declared(self.path)
        except DeclaredHostsError as error:
            self.error = str(error)
            raise
        self.error = ""

    def wants(self, name: str) -> bool:
        """Whether a host's tunnel may be open."""
        host = self.hosts.get(name)
        return host is None or host.wanted


class _Host(Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?\Z")]
    address: IPv4Address | None = None
    groups: Annotated[
        list[Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,62}\Z")]], Meta(max_length=32)
    ] = []
    tunnel: bool = True


class _File(Struct, forbid_unknown_fields=True):
    hosts: list[_Host] = []


def read_declared(path: Path) -> dict[str, DeclaredHost]:
    """The declared hosts by name; none when there is no file. Raises `DeclaredHostsError`."""
    try:
        text = path.read_text(encoding="utf-8")
        if len(text) > _LARGEST:
            raise DeclaredHostsError(f"{path}: longer than {_LARGEST} characters")
        content = yaml.safe_load(text)
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise DeclaredHostsError(f"{path}: the declared hosts cannot be read: {error}") from error
    try:
        file = msgspec.convert(
            {} if content is None else content, _File, dec_hook=lambda kind, value: kind(value)
        )
    except msgspec.ValidationError as error:
        why, _at, place = str(error).partition(" - at `$")
        where = re.sub(r"\W+", ".", place).strip(".") or "the file"
        raise DeclaredHostsError(f"{path}: {where}: {why}") from error
    found: dict[str, DeclaredHost] = {}
    addresses: dict[str, str] = {}
    for host in file.hosts:
        if host.name in found:
            raise DeclaredHostsError(f"{path}: {host.name} is declared twice")
        address = str(host.address) if host.address else None
        if address is not None:
            if address in addresses:
                raise DeclaredHostsError(
                    f"{path}: {host.name} and {addresses[address]} have the same address"
                )
            addresses[address] = host.name
        found[host.name] = DeclaredHost(host.name, address, tuple(dict.fromkeys(host.groups)), host.tunnel)
    return found
