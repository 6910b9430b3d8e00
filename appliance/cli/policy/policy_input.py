"""What the policy verbs read: policies, who is who, and requests out of files or the audit log."""

import functools
import ipaddress
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import asdict

from appliance.audit.log_database import LogUnreadableError
from appliance.audit.query import Filter, FilterError
from appliance.base.input_files import read_given_text
from appliance.channel.admin import RegistrationsWanted
from appliance.cli import output
from appliance.cli.admin_client import NotRunningError
from appliance.cli.target import Appliance
from appliance.policy.actions import BadWordError, find_hosts
from appliance.policy.host_sets import Network, canonical_address, canonical_network
from appliance.policy.judgement import Known
from appliance.policy.live_rights import Live
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy

usage_error = functools.partial(output.usage_error, verb="rosrv policy")
Robot = Annotated[
    list[str] | None, typer.Option("--robot", metavar="ADDRESS", help="What the group robot is (repeatable)")
]
Enrolled = Annotated[
    list[str] | None,
    typer.Option("--enrolled", metavar="NAME=ADDRESS", help="An enrolled host, for host:NAME (repeatable)"),
]


def read_text(file: Path) -> str:
    """The text of a file; what is no UTF-8 becomes U+FFFD, which no policy may contain outside comments."""
    try:
        return read_given_text(file, errors="replace")
    except OSError as error:
        raise usage_error(f"cannot read {file}: {error.strerror}") from error


def known_of(robot: list[str] | None, enrolled: list[str] | None, running: Known | None = None) -> Known:
    """What the options say, before what the running appliance knows."""
    known = running or Known()
    hosts = dict(_enrolled(text) for text in enrolled or ())
    return replace(known, hosts={**known.hosts, **hosts}, robot=networks_of(robot) or known.robot)


def networks_of(robot: list[str] | None) -> list[Network]:
    """What `--robot` says."""
    return [_network(text) for text in robot or ()]


def _network(text: str) -> Network:
    try:
        return canonical_network(ipaddress.ip_network(text))
    except ValueError as error:
        raise usage_error(f"--robot: {error}") from error


def _enrolled(text: str) -> tuple[str, Address]:
    name, _, address = text.partition("=")
    try:
        return name, canonical_address(ipaddress.ip_address(address))
    except ValueError as error:
        raise usage_error(f"--enrolled: expected NAME=ADDRESS, found {text!r}") from error


def find_host(text: str, policy: Policy) -> Address:
    """The address somebody asks from; `robot` with several addresses is its first."""
    try:
        return find_hosts(text, policy)[0]
    except BadWordError as error:
        for word, option in (("robot", "--robot ADDRESS"), ("host:", "--enrolled NAME=ADDRESS")):
            if text.startswith(word):
                raise BadWordError(f"{error}; say it with {option}") from None
        raise


def requests_of_file(file: Path) -> Iterator[Request]:
    """Requests from NDJSON with `host`, `caller_id`, `category`, `resource`, one object per line."""
    for number, line in enumerate(read_text(file).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            fields = json.loads(line)
            yield request_of(fields["host"], fields["caller_id"], fields["category"], fields["resource"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise usage_error(f"{file}:{number}: not a request: {reason}") from error


def request_of(host: str, caller_id: str, category: str, resource: str) -> Request:
    """A request from the strings it was written as; raises ValueError."""
    address = canonical_address(ipaddress.ip_address(host))
    return Request(address, str(caller_id or ""), Category(category), str(resource))


def live_now(appliance: Appliance) -> list[Live]:
    """What is live at the running appliance. Raises `NotRunningError`."""
    answer = appliance.ask(RegistrationsWanted())
    return [Live.of(asdict(row)) for row in answer.given().registrations] if answer.ok else []


def requests_of_audit_log(appliance: Appliance) -> Iterator[Request]:
    """Every request that an appliance's audit log has a decision on.

    Records that sum up many different requests name none and are left out.
    """
    decided = Filter(decision=("allow", "deny", "would deny"))
    try:
        for entry in appliance.audit().export(decided):
            record = entry.record
            if record.host is None or record.category not in set(Category) or record.resource is None:
                continue
            yield request_of(record.host, record.caller_id or "", record.category, record.resource)
    except (LogUnreadableError, NotRunningError, FilterError) as error:
        raise usage_error(str(error)) from error
