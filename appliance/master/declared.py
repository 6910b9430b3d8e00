"""`ipsec/hosts.yaml`: the hosts that are meant to be enrolled, and the addresses kept for them.

hosts:
  - name: ocu-1
    address: 10.113.11.20   # optional
"""

from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError


class DeclaredHostsError(Exception):
    """The file cannot be understood; the text says where and why."""


@dataclass(frozen=True)
class DeclaredHost:
    """A host that is meant to be enrolled."""

    name: str
    address: str | None


class _Host(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$")]
    address: IPv4Address | None = None


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    hosts: list[_Host] = []


def read_declared(path: Path) -> dict[str, DeclaredHost]:
    """The declared hosts by name; none when there is no file. Raises `DeclaredHostsError`."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DeclaredHostsError(f"{path}: the declared hosts cannot be read: {error}") from error
    try:
        file = _File.model_validate({} if content is None else content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise DeclaredHostsError(f"{path}: {where}: {first['msg']}") from error
    found: dict[str, DeclaredHost] = {}
    for host in file.hosts:
        if host.name in found:
            raise DeclaredHostsError(f"{path}: {host.name} is declared twice")
        found[host.name] = DeclaredHost(host.name, str(host.address) if host.address else None)
    return found
