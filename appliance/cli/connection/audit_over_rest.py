"""Read the running appliance's audit log over REST."""

import json
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import msgspec

from appliance.audit.log.ids import ID_OR_SEQUENCE
from appliance.audit.log.record_format import LogEntry, entry_of, rfc3339
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.copies import SignedCheckpoint
from appliance.audit.search.denial_summary import DenialSummary
from appliance.audit.search.query import Filter, FilterError
from appliance.audit.search.search import RecordInContext, SearchPage
from appliance.cli.connection.admin_client import NotRunningError, RestProblemError
from appliance.cli.connection.audit_file import Progress

if TYPE_CHECKING:
    from appliance.cli.connection.rest_session import RestClient

_PATH = "/v1/audit"
_PAGE = 1000
_FOLLOWING = 50
_VERIFY_SECONDS = 3600.0
_SILENCE_SECONDS = 60.0  # a stream sends at least a comment every 15 s
_AGAIN_SECONDS = 1.0
_MAX_FAILURES = 5


class RestLog:
    """The methods of `FileLog` over REST; they raise `NotRunningError`."""

    def __init__(self, client: "RestClient") -> None:
        self._client = client

    def search(self, wanted: Filter, cursor: str | None, limit: int, *, newest_first: bool) -> SearchPage:
        entries: list[LogEntry] = []
        order = "newest" if newest_first else "oldest"
        while True:
            size = min(_PAGE, limit - len(entries))
            params = {**_parameters(wanted), "limit": size, "order": order}
            if cursor is not None:
                params["cursor"] = cursor
            with self._refusals():
                page = self._get("", params)
                entries += map(entry_of, page["records"])
                cursor = page["cursor"]
            if cursor is None or len(entries) >= limit:
                return SearchPage(entries, cursor)

    def denials(self, wanted: Filter, limit: int) -> DenialSummary:
        parameters = {**_parameters(wanted), "limit": limit}
        with self._refusals():
            return msgspec.convert(self._get("/summary", parameters), DenialSummary)

    def show(self, record_id: str, neighbours: int) -> RecordInContext | None:
        if not ID_OR_SEQUENCE.fullmatch(record_id):
            return None
        try:
            with self._refusals():
                found = self._get(f"/{record_id}", {"neighbours": neighbours})
                before, after = ([*map(entry_of, found[name])] for name in ("before", "after"))
                return RecordInContext(entry_of(found["record"]), before, after)
        except _NothingThereError:
            return None

    def export(self, wanted: Filter) -> Iterator[LogEntry]:
        with self._lines("/export", _parameters(wanted), _SILENCE_SECONDS) as lines:
            for line in lines:
                if line:
                    yield entry_of(json.loads(line))

    def snapshot(self) -> "RestSnapshot":
        return RestSnapshot(self)

    def evidence(self, wanted: Filter) -> Iterator[tuple[int, str]]:
        with self._lines("/export", _parameters(wanted), _SILENCE_SECONDS) as lines:
            for line in lines:
                if line:
                    yield int(json.loads(line)["sequence"]), line

    def follow(self, wanted: Filter, lines: int, *, on: bool) -> Iterator[list[LogEntry]]:
        """Yield the last records, then new ones; reconnect when the connection breaks."""
        position = self.last()
        if lines:
            yield self.search(wanted, str(position + 1), lines, newest_first=True).entries[::-1]
        failures, pause = 0, threading.Event()
        while on:
            try:
                with self._lines(
                    "/stream", {**_parameters(wanted), "after": position}, _SILENCE_SECONDS
                ) as stream:
                    failures = 0
                    for entry in self._records(stream):
                        position = entry.sequence
                        yield [entry]
            except _EndedError:
                raise
            except NotRunningError:
                failures += 1
                if failures == _MAX_FAILURES:
                    raise
            pause.wait(_AGAIN_SECONDS)

    def verify(
        self, key: bytes | None, copies: Sequence[SignedCheckpoint] | None, progress: Progress
    ) -> Verification:
        del progress  # REST does not report it
        if key is not None or copies is not None:
            raise FilterError(
                "--key and --checkpoints need the log's file: run this on the appliance's machine with --state"
            )
        with self._refusals():
            return msgspec.convert(self._get("/verify", {}, _VERIFY_SECONDS), Verification)

    def checkpoints(self, after: int) -> list[SignedCheckpoint]:
        with self._refusals():
            found = self._get("/checkpoints", {"after": after})["checkpoints"]
            return msgspec.convert(found, list[SignedCheckpoint])

    def last(self) -> int:
        with self._refusals():
            found = self._get("", {"limit": 1})["records"]
            return int(found[0]["sequence"]) if found else 0

    def _get(self, path: str, params: dict[str, Any], seconds: float = 60.0) -> dict[str, Any]:
        with self._refusals():
            return self._client.call("GET", _PATH + path, params=params, seconds=seconds)

    @contextmanager
    def _lines(self, path: str, params: dict[str, object], seconds: float) -> Iterator[Iterator[str]]:
        with (
            self._refusals(),
            self._client.stream("GET", _PATH + path, params=params, seconds=seconds) as answer,
        ):
            yield answer.iter_lines()

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except RestProblemError as problem:
            if problem.status == 404:
                raise _NothingThereError(str(problem)) from None
            if problem.status == 422:
                raise FilterError("; ".join(problem.lines)) from None
            raise NotRunningError(f"{self._client.url}: {problem}") from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, FilterError):
                raise
            raise NotRunningError(
                f"{self._client.url} is not an appliance's REST API: its answer is not as documented"
            ) from None

    def _records(self, lines: Iterator[str]) -> Iterator[LogEntry]:
        event = ""
        for line in lines:
            name, _colon, value = line.partition(": ")
            if name == "event":
                event = value
            elif name == "data" and event == "record":
                yield entry_of(json.loads(value))
            elif name == "data" and event == "end":
                raise _EndedError(f"{self._client.url}: {json.loads(value)['reason']}")


class RestSnapshot:
    """The methods of `LogSnapshot` over REST: of the log as it is at each step."""

    def __init__(self, log: RestLog) -> None:
        self._log = log

    def close(self) -> None:
        """Do nothing: each step is a request of its own."""

    def of_events(self, events: Collection[str]) -> Iterator[LogEntry]:
        found = [entry for event in events for entry in self._log.export(Filter(event=event))]
        return iter(sorted(found, key=lambda entry: entry.sequence))

    def following(self, event: str, sequence: int) -> Iterator[LogEntry]:
        cursor: str | None = str(sequence)
        while cursor is not None:
            entries, cursor = self._log.search(Filter(event=event), cursor, _FOLLOWING, newest_first=False)
            yield from entries


class _NothingThereError(Exception):
    pass


class _EndedError(NotRunningError):
    """The appliance ended the stream."""


def _parameters(wanted: Filter) -> dict[str, object]:
    fields = msgspec.structs.asdict(wanted)
    fields["looks"] = "0" if fields.pop("without_looks") else None
    params = {name: value for name, value in fields.items() if value not in (None, ())}
    for name in ("since", "until"):
        if name in params:
            params[name] = rfc3339(params[name])
    for name, value in params.items():
        try:
            str(value).encode()
        except UnicodeEncodeError:
            raise FilterError(f"{name}: not valid Unicode") from None
    if "decision" in params:
        params["decision"] = list(wanted.decision)
    return params
