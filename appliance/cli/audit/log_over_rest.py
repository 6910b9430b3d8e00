"""The running appliance's audit log, read over REST."""

import json
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import msgspec

from appliance.audit.chain_findings import Verification
from appliance.audit.copies import SignedCheckpoint
from appliance.audit.query import Filter, FilterError
from appliance.audit.record_format import Entry, entry_of, rfc3339
from appliance.audit.search import Page, Shown
from appliance.cli.admin_client import NotRunningError
from appliance.cli.audit.source import Progress
from appliance.cli.rest.session import ProblemError, RestClient

_PATH = "/v1/audit"
_PAGE = 1000
ID = re.compile("[0-9a-f]{1,20}")  # of a record, or its sequence; anything else is no record's
_VERIFY_SECONDS = 3600.0
_SILENCE_SECONDS = 60.0  # a stream says something every 15 s
_AGAIN_SECONDS = 1.0
_MOST_FAILURES = 5


class RestLog:
    """Reads the log with the token of a client."""

    def __init__(self, client: RestClient) -> None:
        self._client = client

    def search(self, wanted: Filter, cursor: str | None, limit: int, *, newest_first: bool) -> Page:
        """A page of records."""
        entries: list[Entry] = []
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
                return Page(entries, cursor)

    def show(self, record_id: str, neighbours: int) -> Shown | None:
        """One record with its neighbours; None when there is none."""
        if not ID.fullmatch(record_id):
            return None
        try:
            with self._refusals():
                found = self._get(f"/{record_id}", {"neighbours": neighbours})
                before, after = ([*map(entry_of, found[name])] for name in ("before", "after"))
                return Shown(entry_of(found["record"]), before, after)
        except _NothingThereError:
            return None

    def export(self, wanted: Filter) -> Iterator[Entry]:
        """All records that match, the oldest first."""
        with self._lines("/export", _parameters(wanted), _SILENCE_SECONDS) as lines:
            for line in lines:
                if line:
                    yield entry_of(json.loads(line))

    def evidence(self, wanted: Filter) -> Iterator[tuple[int, str]]:
        """The same with their places in the chain, as the appliance gives them: sequences and lines."""
        with self._lines("/export", _parameters(wanted), _SILENCE_SECONDS) as lines:
            for line in lines:
                if line:
                    yield int(json.loads(line)["sequence"]), line

    def follow(self, wanted: Filter, lines: int, *, on: bool) -> Iterator[list[Entry]]:
        """The last records that match, then those that come; a connection that breaks is made anew."""
        position = self.last()
        if lines:
            yield self.search(wanted, str(position + 1), lines, newest_first=True).entries[::-1]
        failures, pause = 0, threading.Event()
        while on:
            try:
                with self._lines(
                    "/stream", {**_parameters(wanted), "after": position}, _SILENCE_SECONDS
                ) as said:
                    failures = 0
                    for entry in self._records(said):
                        position = entry.sequence
                        yield [entry]
            except _EndedError:
                raise
            except NotRunningError:
                failures += 1
                if failures == _MOST_FAILURES:
                    raise
            pause.wait(_AGAIN_SECONDS)

    def verify(
        self, key: bytes | None, copies: Sequence[SignedCheckpoint] | None, progress: Progress
    ) -> Verification:
        """Whether it is complete and unchanged, as the appliance finds."""
        del progress  # REST does not say how far it is
        if key is not None or copies is not None:
            raise FilterError(
                "--key and --checkpoints are held against the log's file: verify it on its machine (--state)"
            )
        with self._refusals():
            return msgspec.convert(self._get("/verify", {}, _VERIFY_SECONDS), Verification)

    def checkpoints(self, after: int) -> list[SignedCheckpoint]:
        """Signed checkpoints after a number, in order."""
        with self._refusals():
            found = self._get("/checkpoints", {"after": after})["checkpoints"]
            return msgspec.convert(found, list[SignedCheckpoint])

    def last(self) -> int:
        """The sequence of the last record."""
        with self._refusals():
            found = self._get("", {"limit": 1})["records"]
            return int(found[0]["sequence"]) if found else 0

    def _get(self, path: str, params: dict[str, Any], seconds: float = 60.0) -> dict[str, Any]:
        with self._refusals():
            return self._client.call("GET", _PATH + path, params=params, seconds=seconds)

    @contextmanager
    def _lines(self, path: str, params: dict[str, Any], seconds: float) -> Iterator[Iterator[str]]:
        """The lines of an answer while it comes; what is in them may be read inside."""
        with (
            self._refusals(),
            self._client.streamed("GET", _PATH + path, params=params, seconds=seconds) as answer,
        ):
            yield answer.iter_lines()

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """A refusal is told as it is when the log's file is read; so is an answer that is none."""
        try:
            yield
        except ProblemError as problem:
            if problem.status == 404:
                raise _NothingThereError(str(problem)) from None
            if problem.status == 422:
                raise FilterError("; ".join(problem.lines)) from None
            raise NotRunningError(f"{self._client.url}: {problem}") from None
        except (msgspec.ValidationError, ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, FilterError):
                raise
            raise NotRunningError(
                f"{self._client.url} is not the REST of an appliance: its answer is not as documented"
            ) from None

    def _records(self, lines: Iterator[str]) -> Iterator[Entry]:
        event = ""
        for line in lines:
            name, _colon, value = line.partition(": ")
            if name == "event":
                event = value
            elif name == "data" and event == "record":
                yield entry_of(json.loads(value))
            elif name == "data" and event == "end":
                raise _EndedError(f"{self._client.url}: {json.loads(value)['reason']}")


class _NothingThereError(Exception):
    """There is no such record."""


class _EndedError(NotRunningError):
    """The stream is over for good."""


def _parameters(wanted: Filter) -> dict[str, Any]:
    fields = {name: getattr(wanted, name) for name in Filter.__struct_fields__}
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
