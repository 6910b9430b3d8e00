"""What operators' tools ask of the running appliance over its admin socket, and what they are answered.

One JSON document per line in each direction, one request per connection at a time. The socket is in the state
directory, for its owner and root only.
"""

from typing import Any

import msgspec


class AdminRequest(msgspec.Struct, frozen=True, tag_field="verb", forbid_unknown_fields=True):
    """A question or an order to the running appliance."""


class StatusWanted(AdminRequest, frozen=True, tag="status"):
    """Processes, policy, registry, relay, firewall: what `rosrv status` shows."""


class PolicyReload(AdminRequest, frozen=True, tag="policy reload"):
    """Read the policy file again; back by itself after `confirm_within` seconds unless confirmed."""

    confirm_within: float | None = None


class PolicyRollback(AdminRequest, frozen=True, tag="policy rollback"):
    """Back to a kept revision; None: the one before the present."""

    revision: int | None = None


class PolicyConfirm(AdminRequest, frozen=True, tag="policy confirm"):
    """Keep a change that would go back by itself."""


class PolicyRevisions(AdminRequest, frozen=True, tag="policy revisions"):
    """The kept revisions."""


class RegistrationsWanted(AdminRequest, frozen=True, tag="registrations"):
    """What is registered now: rows of host, caller_id, category, resource."""


AnyRequest = StatusWanted | PolicyReload | PolicyRollback | PolicyConfirm | PolicyRevisions | RegistrationsWanted


class AdminAnswer(msgspec.Struct, frozen=True):
    """The answer: `ok` with a body, or an error with its findings."""

    ok: bool
    body: dict[str, Any] = {}
    error: str = ""
    findings: list[str] = []
