"""Read the input of the policy verbs: policies, addresses of hosts, and requests."""

import contextlib
import functools
import ipaddress
import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import typer
from msgspec.structs import asdict

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.audit.log.repetition import KIND, PARAMETERS, repetitions
from appliance.audit.search.query import Filter, FilterError
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.input_files import read_given_text
from appliance.channel.admin import PolicyWanted, RegistrationsWanted
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.cli import output
from appliance.cli.connection.admin_client import NotRunningError, RestProblemError
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance
from appliance.cli.durations import time_given
from appliance.features.policy_tools.learn import Observation, is_covered, needed_rights
from appliance.policy import sections
from appliance.policy.actions import BadWordError, find_host
from appliance.policy.host_sets import Network, canonical_address, canonical_network
from appliance.policy.judgement import PolicyContext, approvals_of, ends_of
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import Right

# Read the requests of a period that passed, and say which of them the log no longer names.

ReadRecords: TypeAlias = Callable[[Filter], Iterator[LogEntry]]
"""Returns the records found, oldest first."""

ADOPTED = "adopted"
"""The event of a registration that was taken over from a ROS master, not made by the node itself."""
_EVENTS = ("decision", ADOPTED, "repetitions folded", "denials folded")
_OWN_NODE = "the appliance's own node"
_OWN_TOOLS = "/rosrv_"
"""The names of the nodes of our own tools begin so."""


@dataclass(frozen=True)
class RecordedPeriod:
    """The requests of the log since a time, or all of them. Times are nanoseconds since the epoch.

    `start` is when the log's part of the period begins. `removed`: earlier records of the period are removed.
    `hosts` limits it to their requests, unless it is empty. `unnamed` has, for each host, the number of requests that
    passed and that the log only counts together with others of other names; `*` stands for several hosts.
    """

    read: ReadRecords
    since: int | None
    start: int
    removed: bool
    hosts: Collection[Network] = ()
    unnamed: dict[str, int] = field(default_factory=dict)

    def requests(self) -> Iterator[Observation]:
        """Yield the requests by the kinds of their records, and fill `unnamed`. Raises what `read` raises."""
        self.unnamed.clear()
        for event in _EVENTS:
            passed = Filter(decision=("allow", "would deny"), event=event, since=self.since)
            for entry in self.read(passed):
                host = entry.record.host
                if not self.hosts or host is None or is_covered(_network_of(host), self.hosts):
                    yield from self._of(entry.record)

    def notes(self, appliance: Appliance, what: str) -> Iterator[str]:
        """Yield a line for each part of the period without names. `what` is for requests, such as "compared"."""
        if self.removed:
            when = "" if self.since is None else " of that time"
            yield f"earlier records{when} are removed from the log"
        for host, count in sorted(self.unnamed.items()):
            who = "several hosts" if host == "*" else appliance.host_in_words(host)
            yield f"not {what}: {counted(count, 'request')} of {who}, which the log only counts"

    def _of(self, record: AuditRecord) -> Iterator[Observation]:
        detail, caller = record.detail, record.caller_id or ""
        if _is_ours(record):
            return
        scope = detail.get("scope", KIND)
        if scope != KIND:
            host = record.host or "*"
            self.unnamed[host] = self.unnamed.get(host, 0) + repetitions(detail)
            return
        if record.host is None or record.category not in set(Category):
            return
        request = request_of(record.host, caller, str(record.category), record.resource or "")
        call, approval, adopted = str(detail.get("call", "")), "approval" in detail, record.event == ADOPTED
        number = 1 if record.event in ("decision", ADOPTED) else repetitions(detail)
        for name, count in detail.get(PARAMETERS, {detail.get("key", ""): number}).items():
            yield Observation(request, call, str(name), approval, adopted, count)


def _is_ours(record: AuditRecord) -> bool:
    """Return whether the appliance's own node made the request, which no policy decides, or a tool of ours."""
    return record.reason == _OWN_NODE or (record.caller_id or "").startswith(_OWN_TOOLS)


def period_since(read: ReadRecords, since: int | None, now: int) -> RecordedPeriod:
    """Return the period since a time, or all of the log; an empty log begins `now`. Raises what `read` raises."""
    first = next(islice(read(Filter()), 1), None)
    if first is None:
        return RecordedPeriod(read, since, now if since is None else since, removed=False)
    start = max(first.record.time, since or first.record.time)
    removed = first.sequence > 1 and (since is None or first.record.time > since)
    return RecordedPeriod(read, since, start, removed)


def _network_of(host: str) -> Network:
    return canonical_network(ipaddress.ip_network(host))


def request_of(host: str, caller_id: str, category: str, resource: str) -> Request:
    address = canonical_address(ipaddress.ip_address(host))
    return Request(address, str(caller_id or ""), Category(category), str(resource))


usage_error = functools.partial(output.usage_error, verb="rosrv policy")
Robot = Annotated[
    list[str] | None,
    typer.Option("--robot", metavar="ADDRESS", help="Address or network of the group `robot` (repeatable)"),
]
Enrolled = Annotated[
    list[str] | None,
    typer.Option(
        "--enrolled",
        metavar="NAME=ADDRESS",
        help="Address of `host:NAME`; for a door: door:NAME=ADDRESS (repeatable)",
    ),
]


def read_text(file: Path) -> str:
    """Return the text of a file. Invalid UTF-8 becomes U+FFFD, which policies allow only in comments."""
    try:
        return read_given_text(file, errors="replace")
    except OSError as error:
        raise usage_error(f"cannot read {file}: {error.strerror}") from error


def known_of(
    robot: list[str] | None, enrolled: list[str] | None, running: PolicyContext | None = None
) -> PolicyContext:
    known = running or PolicyContext(now=clock.wall())
    hosts = dict(_parse_enrolled(text) for text in enrolled or ())
    return replace(known, hosts={**known.hosts, **hosts}, robot=networks_of(robot) or known.robot)


def networks_of(given: list[str] | None, option: str = "--robot") -> list[Network]:
    try:
        return [_network_of(text) for text in given or ()]
    except ValueError as error:
        raise usage_error(f"{option}: {error}; write 192.168.1.20 or 192.168.1.0/24") from error


def _parse_enrolled(text: str) -> tuple[str, Address]:
    name, _, address = text.partition("=")
    try:
        return name, canonical_address(ipaddress.ip_address(address))
    except ValueError as error:
        raise usage_error(f"--enrolled: {text!r} is not NAME=ADDRESS, such as arm=10.0.0.7") from error


def policy_in_force(
    appliance: Appliance, robot: list[str] | None, enrolled: list[str] | None
) -> tuple[str, str, PolicyContext]:
    body = body_in_force(appliance)
    return body.text, body.file, known_of(robot, enrolled, context_of(body))


def body_in_force(appliance: Appliance) -> PolicyInForce:
    return appliance.ask_or_exit(PolicyWanted()) if appliance.place is None else _over_rest(appliance)


def context_of(body: PolicyInForce) -> PolicyContext:
    return PolicyContext(
        {name: canonical_address(ipaddress.ip_address(address)) for name, address in body.hosts.items()},
        [ipaddress.ip_network(place) for place in body.robot],
        blocks={ipaddress.ip_address(address): block for address, block in body.blocks.items()},
        holders={group: ipaddress.ip_address(host) for group, host in body.holders.items()},
        approved=approvals_of(body.approved),
        own=[ipaddress.ip_address(address) for address in body.own],
        now=body.now,
        ends=ends_of(body.ended, body.lasting),
    )


def running_robot(appliance: Appliance) -> list[Network]:
    body = appliance.ask(PolicyWanted()).unwrap() if appliance.place is None else _over_rest(appliance)
    return [canonical_network(ipaddress.ip_network(place)) for place in (*body.robot, *body.own)]


def _over_rest(appliance: Appliance) -> PolicyInForce:
    try:
        return msgspec.convert(appliance.rest.call("GET", "/v1/policy"), PolicyInForce)
    except msgspec.ValidationError as error:
        text = f"{appliance.place}: this appliance's version gives a different answer: {error}"
        raise usage_error(f"{text}; use the rosrv of its version") from error
    except (NotRunningError, RestProblemError) as error:
        raise usage_error(str(error)) from error


def asking_host(text: str, policy: Policy) -> Address:
    try:
        return find_host(text, policy)
    except BadWordError as error:
        for word, option in (
            ("robot", "--robot ADDRESS"),
            ("host:", "--enrolled NAME=ADDRESS"),
            ("door:", "--enrolled door:NAME=ADDRESS"),
        ):
            if text.startswith(word):
                raise BadWordError(f"{error}; give it with {option}") from None
        raise


def requests_of_file(file: Path) -> Iterator[Request]:
    """Yield the requests of an NDJSON file with `host`, `caller_id`, `category`, `resource`."""
    for number, line in enumerate(read_text(file).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            fields = json.loads(line)
            yield request_of(fields["host"], fields["caller_id"], fields["category"], fields["resource"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise usage_error(
                f"{file}:{number}: not a request: write an object with host (an address), caller_id, category, resource"
            ) from error


def live_now(appliance: Appliance) -> list[LiveRight]:
    """Return the rights of running nodes. Exits if the appliance refuses; raises `NotRunningError`."""
    found = appliance.body_or_exit(appliance.ask(RegistrationsWanted())).registrations
    return [LiveRight.of(asdict(row)) for row in found]


def recorded_period(appliance: Appliance, since: str | None, host: list[str] | None = None) -> RecordedPeriod:
    """Return the period since a time, or all of the log; without `host`, of all hosts.

    Exits with usage errors, and if the log is unreadable.
    """

    def read(wanted: Filter) -> Iterator[LogEntry]:
        try:
            yield from audit_of(appliance.way).export(wanted)
        except (LogUnreadableError, NotRunningError, FilterError) as error:
            raise usage_error(str(error)) from error

    asked = None if since is None else time_given("--since", since, "rosrv policy")
    return replace(period_since(read, asked, clock.wall_ns()), hosts=networks_of(host, "--host"))


def requests_of_audit_log(appliance: Appliance) -> Iterator[Request | Right]:
    """Yield the decided requests of nodes with their rights to parameters, if their records name them."""
    decided = Filter(decision=("allow", "deny", "would deny", "ask"))
    try:
        for entry in audit_of(appliance.way).export(decided):
            record = entry.record
            if record.host is None or record.category not in set(Category) or record.resource is None:
                continue
            if _is_ours(record):
                continue
            request = request_of(record.host, record.caller_id or "", record.category, record.resource)
            yield request
            call, key = str(record.detail.get("call", "")), record.detail.get("key")
            for name in record.detail.get(PARAMETERS, [] if key is None else [key]):
                with contextlib.suppress(BadWordError):
                    needed = needed_rights(Observation(request, call, str(name)))
                    yield from (Right(right) for right in needed if right.category in sections.PARAMETERS)
    except (LogUnreadableError, NotRunningError, FilterError) as error:
        raise usage_error(str(error)) from error
