"""Keep the grants of the relays: the topics and services that each client may use. No I/O.

Grants are stored, because a ROS node never asks twice. Above its limit, a host loses its oldest grants without a
connection; above the common limit, the host with the most grants does.
"""

from collections.abc import Callable, Collection, Iterable

from appliance.quotas.pool import Bounds
from appliance.quotas.table import GRANTS
from appliance.store.state_file import PermissionRow

_CLEARED_AT_ONCE = 1000
_Index = dict[str, dict[PermissionRow, None]]  # the oldest grant first


class Grants:
    """All grants. `mark` notes a change; `used()` returns the grants that have a connection now."""

    def __init__(
        self,
        mark: Callable[[PermissionRow], None],
        used: Callable[[], Collection[PermissionRow]],
        bounds: Bounds = GRANTS.bounds,
    ) -> None:
        self._mark = mark
        self.used = used
        self._bounds = bounds
        self._of_node: _Index = {}  # by key of the publisher or provider
        self._of_host: _Index = {}  # by client host
        self._of_name: _Index = {}  # by name of the client
        self._count = 0

    def restore(self, rows: Iterable[PermissionRow]) -> None:
        """Restore stored grants, but erase those of an earlier version that were for all names of a host.

        The clients of erased grants look up the service again.
        """
        for row in rows:
            if row.caller_id:
                self._add(row)
            else:
                self._mark(row)

    def all(self) -> list[PermissionRow]:
        return [row for rows in self._of_node.values() for row in rows]

    def of(self, key: str) -> Collection[PermissionRow]:
        return self._of_node.get(key, ())

    def of_client(self, name: str) -> list[PermissionRow]:
        return list(self._of_name.get(name, ()))

    def give(self, row: PermissionRow) -> None:
        """Give a grant, which becomes the newest of its host even if it existed before."""
        new = row not in self.of(row.key)
        self._add(row)
        if not new:
            return
        self._mark(row)
        if len(self._of_host[row.host]) > self._bounds.host:
            self._clear_unused(row.host, row)
        elif self._count > self._bounds.whole:
            self._clear_unused(max(self._of_host, key=lambda host: len(self._of_host[host])), row)

    def take(self, row: PermissionRow) -> None:
        if row not in self.of(row.key):
            return
        for index, key in self._places(row):
            del index[key][row]
            if not index[key]:
                del index[key]
        self._count -= 1
        self._mark(row)

    def forget(self, key: str) -> None:
        for row in list(self.of(key)):
            self.take(row)

    def _add(self, row: PermissionRow) -> None:
        self._count += row not in self.of(row.key)
        for index, key in self._places(row):
            rows = index.setdefault(key, {})
            rows[row] = rows.pop(row, None)

    def _places(self, row: PermissionRow) -> tuple[tuple[_Index, str], ...]:
        return (self._of_node, row.key), (self._of_host, row.host), (self._of_name, row.caller_id)

    def _clear_unused(self, host: str, newest: PermissionRow) -> None:
        used = self.used()
        unused = [row for row in self._of_host[host] if row != newest and row not in used]
        for row in unused[:_CLEARED_AT_ONCE]:
            self.take(row)
