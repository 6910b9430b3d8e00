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

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

_LARGEST = 1 << 20
_MOST_GROUPS = 32
_GROUP = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


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


class _Host(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$")]
    address: IPv4Address | None = None
    groups: Annotated[
        list[Annotated[str, Field(pattern=f"^{_GROUP.pattern}$")]], Field(max_length=_MOST_GROUPS)
    ] = []
    tunnel: bool = True


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
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
        file = _File.model_validate({} if content is None else content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise DeclaredHostsError(f"{path}: {where}: {first['msg']}") from error
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
