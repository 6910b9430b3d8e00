"""Define the feature syslog."""

from appliance.configuration.sections import Sections
from appliance.features.feature import Feature
from appliance.features.syslog.settings import Syslog
from appliance.supervisor.role import Facts, RemoteReceiver, Role
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

ROLE = "syslog"


def _receiver(sections: Sections) -> RemoteReceiver | None:
    wanted = sections.of(Syslog)
    return None if wanted.to is None else RemoteReceiver("audit log's forwarder", *wanted.destination)


def _sandbox(facts: Facts) -> SandboxPlan:
    receiver = _receiver(facts.sections)
    return SandboxPlan(
        allowlist=True,
        families=ROUTES,
        reads=(str(facts.part("control")), *folders_of(*facts.sections.of(Syslog).files)),
        connects=None if receiver is None or receiver.protocol == "udp" else (receiver.port,),
    )


FEATURE = Feature(
    settings=Syslog,
    roles=(
        Role(
            ROLE, "rosrv-syslog", "syslog", "appliance.features.syslog.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=600, nice=10, after="control",
            dispensable=True, group="rosrv-api", inputs=lambda facts: facts.sections.of(Syslog).files,
            sandbox=_sandbox, configured=lambda sections: sections.of(Syslog).to is not None, receiver=_receiver,
        ),
    ),
)  # fmt: skip
