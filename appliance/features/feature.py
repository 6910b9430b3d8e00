"""Define a feature: everything that it adds to the core.

Invariants:

1. The core knows these classes and `table.py`, and nothing else of a feature. No feature imports another one.
2. Each process loads the table, so a row imports only settings and roles. `make` and entries of roles import the rest
   when they are called, in the process that needs it.
3. No feature imports `configuration.settings` except in the entry of a process, because the settings import the table.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from appliance.base.verbs import Verbs
from appliance.configuration.sections import FeatureSection, Sections
from appliance.supervisor.role import Role

if TYPE_CHECKING:
    from appliance.channel.answers.status import ForwardingState
    from appliance.channel.link import Link
    from appliance.telemetry.audit_trail import AuditTrail


@dataclass(frozen=True)
class FeatureContext:
    """Hold the objects of control that parts of features use."""

    sections: Sections
    trail: "AuditTrail"


@dataclass(frozen=True)
class FeaturePart:
    """The part of control that a feature adds.

    `links` are control's ends of the links to the feature's roles, with the messages that control accepts.
    `forwarding` returns the state of the forwarding of the audit log, or None if none is configured.
    """

    links: "Mapping[str, tuple[Link, Any]]" = field(default_factory=dict)
    forwarding: "Callable[[], ForwardingState | None]" = lambda: None


@dataclass(frozen=True)
class Feature:
    """All that a feature adds: a section of `appliance.yaml`, processes, verbs of `rosrv`, and a part of control."""

    name: str
    settings: type[FeatureSection] | None = None
    roles: tuple[Role, ...] = ()
    verbs: Verbs = field(default_factory=dict)
    make: Callable[[FeatureContext], FeaturePart] | None = None
