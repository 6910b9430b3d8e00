"""Read `ipsec/hosts.yaml` (docs/tunnels.md), which declares the hosts to enrol, at start and on reload.

The file is never written. An invalid file changes nothing, even at a start, and the status reports the error.
"""

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import yaml

from appliance.base.input_files import read_given_text
from appliance.base.validation_messages import meant, not_yaml
from appliance.policy.policy_findings import quote
from appliance.telemetry.text_changes import changed_lines

IN_BUNDLE = "hosts.yaml of the bundle"
BUNDLED_HOSTS = "bundled hosts"
"""The setting of the store that keeps the text of a bundle."""
DECLARED_HOSTS = "declared hosts"
"""The setting of the store that keeps the file's last valid text."""

_LARGEST = 1 << 20
_MAX_GROUPS = 32
_MAX_MISTAKES = 5
_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?")
_GROUP = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


class DeclaredHostsError(Exception):
    """The file is invalid."""


@dataclass(frozen=True)
class DeclaredHost:
    """A declared host; `wanted`: the tunnel may be open."""

    name: str
    address: str | None
    groups: tuple[str, ...] = ()
    wanted: bool = True


class DeclaredHosts:
    """The declared hosts; `error` is the reason if the text is invalid now.

    `bundled` is the text of a fleet's bundle, `text` the file's last valid text, at a start the stored one.
    """

    def __init__(self, path: Path, bundled: str = "", text: str = "") -> None:
        self.path = path
        self.bundled = bundled
        self.hosts: dict[str, DeclaredHost] = {}
        self.error, self.text = "", text
        try:
            if bundled:
                self.hosts = parse_declared(bundled, IN_BUNDLE)
            else:
                self.text, self.hosts = _read(path)
        except DeclaredHostsError as error:
            self.error = str(error)
            with contextlib.suppress(DeclaredHostsError):  # an earlier version read it
                self.hosts = parse_declared(text, str(path))

    @property
    def in_force(self) -> str:
        """Return the text in force: of the bundle, or of the file when it was last valid."""
        return self.bundled or self.text

    def changed_lines(self, earlier: str) -> list[str]:
        """Return the lines in which the text in force differs from an earlier one."""
        return changed_lines({"hosts.yaml": earlier}, {"hosts.yaml": self.in_force})

    @property
    def there(self) -> bool:
        return bool(self.hosts)

    def reload(self) -> None:
        """Read the file again. Raises `DeclaredHostsError`, and then keeps the earlier content."""
        try:
            self.text, self.hosts = _read(self.path)
        except DeclaredHostsError as error:
            self.error = str(error)
            raise
        self.error = self.bundled = ""

    def take(self, text: str) -> None:
        """Take the text of a bundle. Raises `DeclaredHostsError`, and then changes nothing."""
        self.hosts = parse_declared(text, IN_BUNDLE)
        self.error, self.bundled = "", text or "\n"

    @property
    def source(self) -> str:
        return IN_BUNDLE if self.bundled else str(self.path)

    def wants(self, name: str) -> bool:
        host = self.hosts.get(name)
        return host is None or host.wanted


def read_declared(path: Path) -> dict[str, DeclaredHost]:
    """Return the hosts in a file; a missing file has none. Raises `DeclaredHostsError`."""
    return _read(path)[1]


def _read(path: Path) -> tuple[str, dict[str, DeclaredHost]]:
    try:
        text = read_given_text(path)
    except FileNotFoundError:
        return "", {}
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise DeclaredHostsError(f"{path}: cannot be read: {reason}") from error
    return text, parse_declared(text, str(path))


def parse_declared(text: str, path: str) -> dict[str, DeclaredHost]:
    if len(text) > _LARGEST:
        raise DeclaredHostsError(f"{path}: longer than {_LARGEST} characters: declare fewer hosts")
    reading = _Reading()
    try:
        reading.file(yaml.compose(text, Loader=yaml.SafeLoader))
    except yaml.MarkedYAMLError as error:
        place = _place(error.problem_mark) if error.problem_mark else "1:1"
        raise DeclaredHostsError(f"{path}:{place}: {not_yaml(error.problem)}") from error
    except (yaml.YAMLError, RecursionError) as error:
        reason = "nested too deeply, or refers to itself" if isinstance(error, RecursionError) else str(error)
        raise DeclaredHostsError(f"{path}: {not_yaml(reason)}") from error
    if reading.mistakes:
        more = len(reading.mistakes) - _MAX_MISTAKES
        told = [f"{path}:{mistake}" for mistake in reading.mistakes[:_MAX_MISTAKES]]
        raise DeclaredHostsError("; ".join([*told, *([f"and {more} more"] if more > 0 else [])]))
    return reading.found


def _place(mark: yaml.Mark) -> str:
    return f"{mark.line + 1}:{mark.column + 1}"


def _name(value: object) -> str:
    if isinstance(value, str) and _NAME.fullmatch(value):
        return value
    raise ValueError("a name is of letters, digits, `.`, `_` and `-`, at most 63: `name: ocu-1`")


def _address(value: object) -> str | None:
    try:
        return None if value is None else str(IPv4Address(str(value)))
    except ValueError:
        raise ValueError("an IPv4 address is four numbers: `address: 10.113.11.20`") from None


def _groups(value: object) -> tuple[str, ...]:
    groups = value if isinstance(value, list) else [None]
    if len(groups) <= _MAX_GROUPS and all(
        isinstance(group, str) and _GROUP.fullmatch(group) for group in groups
    ):
        return tuple(dict.fromkeys(groups))
    raise ValueError(f"groups are a list of at most {_MAX_GROUPS} names: `groups: [operators]`")


def _tunnel(value: object) -> bool:
    if isinstance(value, bool):
        return value
    raise ValueError("a tunnel is true or false: `tunnel: true` or `tunnel: false`")


_KEYS: dict[str, Callable[[object], object]] = {
    "name": _name,
    "address": _address,
    "groups": _groups,
    "tunnel": _tunnel,
}


class _Reading:
    """Reads the text, and collects mistakes with line and column."""

    def __init__(self) -> None:
        self.found: dict[str, DeclaredHost] = {}
        self.mistakes: list[str] = []

    def file(self, node: yaml.Node | None) -> None:
        if node is None:
            return
        for _, value in self._pairs(node, ["hosts"], "`hosts:`, and under it `- name: ocu-1` for each host"):
            if not isinstance(value, yaml.SequenceNode):
                self._mistake(
                    value, "hosts are a list: write `- name: ocu-1` for each, or `hosts: []` for none"
                )
                continue
            for host in value.value:
                self._host(host)

    def _host(self, node: yaml.Node) -> None:
        values: dict[str, Any] = {}
        mistakes = len(self.mistakes)
        for key, value in self._pairs(node, list(_KEYS), "`- name: ocu-1` for a host"):
            given = yaml.constructor.SafeConstructor().construct_object(value, deep=True)
            try:
                values[key] = _KEYS[key](given)
            except ValueError as error:
                self._mistake(value, f"{key} is {quote(str(given))}; {error}")
        if len(self.mistakes) > mistakes:
            return
        if "name" not in values:
            self._mistake(node, "this host has no name: write `name: ocu-1`")
            return
        host = DeclaredHost(
            values["name"], values.get("address"), values.get("groups", ()), values.get("tunnel", True)
        )
        if host.name in self.found:
            self._mistake(node, f"{host.name} is declared twice; remove one of them")
            return
        for other in self.found.values():
            if host.address is not None and other.address == host.address:
                self._mistake(node, f"{host.name} and {other.name} have the same address; change one of them")
        self.found[host.name] = host

    def _pairs(self, node: yaml.Node, known: list[str], form: str) -> Iterator[tuple[str, yaml.Node]]:
        if not isinstance(node, yaml.MappingNode):
            self._mistake(node, f"write {form}")
            return
        seen: set[str] = set()
        for key, value in node.value:
            name = str(key.value)
            if name not in known:
                hint = meant(name, known) or f"; known here: {', '.join(known)}"
                self._mistake(key, f"unknown key {quote(name)}{hint}")
            elif name in seen:
                self._mistake(key, f"{name} is given twice")
            else:
                yield name, value
            seen.add(name)

    def _mistake(self, node: yaml.Node, text: str) -> None:
        self.mistakes.append(f"{_place(node.start_mark)}: {text}")
