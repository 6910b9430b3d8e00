"""Report all REST calls to control, which records them; equal reads and rejections are folded.

Changes (any call with a valid token except GET) are never folded.
"""

from collections import Counter
from collections.abc import Callable

from appliance.channel.messages.api import RestCalled
from appliance.quotas.peers import ReportShares

FOLD_SECONDS = 10.0
_METHODS = frozenset({"GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_Kind = tuple[str, str, str, str, int, str]


class Journal:
    """Folds and reports calls; the owner calls `flush` every `FOLD_SECONDS`."""

    def __init__(self, tell: Callable[[RestCalled], None], *, kinds: int = 512) -> None:
        self._tell = tell
        self._shares = ReportShares(kinds)
        self._repeated: dict[_Kind, int] = {}
        self.calls: Counter[tuple[str, str]] = Counter()  # number by method and status, for the metrics

    def answered(
        self,
        *,
        host: str,
        who: str,
        method: str,
        path: str,
        status: int,
        reason: str,
        duration_us: int,
        dry: bool = False,
    ) -> None:
        # A client may send invalid text (JSON's \ud800), which cannot be encoded for control.
        path, reason = _text(path), _text(reason)
        self.calls[method if method in _METHODS else "other", str(status)] += 1
        if who and method != "GET":
            self._tell(RestCalled(host, who, method, path, status, reason, duration_us, dry=dry))
            return
        kind = (host, who, method, path, status, reason)
        if kind in self._repeated:
            self._repeated[kind] += 1
        elif (shared := self._shares.rest_of(host)) is None:
            self._repeated[kind] = 0
            self._tell(RestCalled(*kind, duration_us))
        else:
            rest = (shared, "", "", "", status, "further calls, not reported separately")
            self._repeated[rest] = self._repeated.get(rest, 0) + 1

    def flush(self) -> None:
        repeated, self._repeated = self._repeated, {}
        self._shares.clear()
        for kind, count in repeated.items():
            if count:
                self._tell(RestCalled(*kind, 0, count))


def _text(given: str) -> str:
    return given if given.isascii() else given.encode("utf-8", "backslashreplace").decode()
