"""A lab for tests and the demonstration: hosts on one Ethernet, each in a network namespace.

```
with Lab("rosrv-test") as lab:
    robot = lab.host("robot", "10.77.0.10/24", "fd77::10/64")
    process = robot.popen(["rosmaster", "--core"])
```

The bridge has its own namespace, so nothing appears in the machine's, and two labs may use the same addresses at the
same time. Leaving the block ends every process in the lab's namespaces. If the lab's own process is killed, the next
lab with the same prefix deletes them.
"""

import contextlib
import itertools
import os
import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from appliance.network import interfaces
from appliance.network.namespaces import (
    Namespace,
    NetworkError,
    end_processes,
    namespaces,
    require_privileges,
)

INTERFACE = "eth0"
_BRIDGE = "br0"

T = TypeVar("T")


class Host:
    """A namespace with the interfaces `lo` and `eth0`."""

    def __init__(self, name: str, namespace: Namespace, port: str, addresses: tuple[str, ...]) -> None:
        self.name = name
        self.namespace = namespace
        self.port = port  # the bridge's end of the cable
        self.interfaces = addresses

    @property
    def address(self) -> str:
        return self.interfaces[0].partition("/")[0]

    @property
    def address6(self) -> str:
        for text in self.interfaces:
            if ":" in text:
                return text.partition("/")[0]
        raise NetworkError(f"the host {self.name} was given no IPv6 address")

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        return self.namespace.popen(args, **options)

    def run(self, function: Callable[[], T]) -> T:
        """Call `function` in a thread on the host."""
        return self.namespace.run(function)

    def entered(self) -> contextlib.AbstractContextManager[None]:
        """Move the calling thread to the host for a block, which must not await."""
        return self.namespace.inside()


class Lab:
    """A lab whose namespaces have names that begin with `prefix`."""

    _numbers = itertools.count(1)

    def __init__(self, prefix: str) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9-]{0,31}", prefix):
            raise ValueError(f"{prefix!r} is not a lab prefix: use small letters, digits and -")
        self.prefix = prefix
        self._mark = f"{prefix}.{os.getpid()}.{next(self._numbers)}"
        self.switch = Namespace(f"{self._mark}.switch")
        self.hosts: dict[str, Host] = {}

    def __enter__(self) -> Self:
        require_privileges("a lab of network namespaces")
        clear_leftovers(self.prefix)
        try:
            self.switch.create()
            interfaces.set_link(self.switch, "lo", up=True)
            interfaces.create_bridge(self.switch, _BRIDGE)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def host(self, name: str, *addresses: str, gateway: str | None = None) -> Host:
        """Add a host with addresses such as `10.77.0.10/24` and `fd77::10/64`."""
        if name in self.hosts:
            raise ValueError(f"the lab has a host {name} already")
        if not addresses:
            raise ValueError(f"the host {name} needs an address such as 10.77.0.10/24")
        namespace = Namespace(f"{self._mark}.{name}").create()
        port = f"port{len(self.hosts)}"
        self.hosts[name] = host = Host(name, namespace, port, addresses)
        interfaces.set_link(namespace, "lo", up=True)
        interfaces.create_veth(namespace, INTERFACE, self.switch, port)
        interfaces.attach(self.switch, port, _BRIDGE)
        for address in addresses:
            interfaces.add_address(namespace, INTERFACE, address)
        if gateway is not None:
            interfaces.add_route(namespace, "default", gateway)
        return host

    def unplug(self, host: Host) -> None:
        interfaces.set_link(self.switch, host.port, up=False)

    def plug(self, host: Host) -> None:
        interfaces.set_link(self.switch, host.port, up=True)

    def close(self) -> None:
        _clear([*(host.namespace for host in self.hosts.values()), self.switch])
        self.hosts.clear()


def clear_leftovers(prefix: str) -> list[str]:
    """Delete the labs of this prefix whose process has ended, and return the names of their namespaces."""
    pattern = re.compile(re.escape(prefix) + r"\.(\d+)\.\d+\.")
    left = []
    for namespace in namespaces(prefix + "."):
        found = pattern.match(namespace.name)
        if found is not None and not Path("/proc", found[1]).exists():
            left.append(namespace)
    _clear(left)
    return [namespace.name for namespace in left]


def _clear(gone: Sequence[Namespace]) -> None:
    end_processes([pid for namespace in gone for pid in namespace.processes()])
    for namespace in gone:
        namespace.delete()
