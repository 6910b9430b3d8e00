"""Define a feature: everything that it adds to the core.

Invariants:

1. The core knows these classes and `table.py`, and nothing else of a feature. No feature imports another one.
2. Each process loads the table, so a row imports only settings and roles. `make`, `operations` and entries of roles
   import the rest when they are called, in the process that needs it; routes and verbs are named by strings.
3. No feature imports `configuration.settings` except in the entry of a process, because the settings import the table.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group
from appliance.configuration.sections import FeatureSection, Sections
from appliance.supervisor.role import Role

if TYPE_CHECKING:
    from appliance.audit.log.log import AuditLog
    from appliance.channel.admin import AdminRequest
    from appliance.channel.answers.status import ForwardingState
    from appliance.channel.link import Link
    from appliance.control.operators.request_method import RequestMethod
    from appliance.telemetry.audit_trail import AuditTrail


@dataclass(frozen=True)
class FeatureContext:
    """Hold the objects of control that parts of features use. `robot` is the robot's name, empty if it has none."""

    sections: Sections
    trail: "AuditTrail"
    audit: "AuditLog"
    robot: str


@dataclass(frozen=True)
class FeaturePart:
    """The part of control that a feature adds.

    `links` are control's ends of the links to the feature's roles, with the messages that control accepts.
    `methods` answer the feature's `operations`.
    `forwarding` returns the state of the forwarding of the audit log, or None if none is configured.
    """

    links: "Mapping[str, tuple[Link, Any]]" = field(default_factory=dict)
    forwarding: "Callable[[], ForwardingState | None]" = lambda: None
    methods: "tuple[RequestMethod[Any], ...]" = ()


@dataclass(frozen=True)
class Feature:
    """All that a feature adds: a section of `appliance.yaml`, processes, requests, verbs, and a part of control.

    `operations` returns the requests of operators' tools; the admin socket, REST and the client follow from their
    rows. `routes` is the function (`module:function`) that returns further routes of the api for its `Services`.
    `verbs` are commands of `rosrv`.
    """

    name: str
    settings: type[FeatureSection] | None = None
    roles: tuple[Role, ...] = ()
    operations: "Callable[[], tuple[type[AdminRequest[Any]], ...]]" = lambda: ()
    routes: str | None = None
    verbs: Mapping[str, Group] = field(default_factory=dict)
    make: Callable[[FeatureContext], FeaturePart] | None = None
