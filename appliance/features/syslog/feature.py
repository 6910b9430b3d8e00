"""Define the feature syslog."""

from appliance.features.feature import Feature
from appliance.features.syslog.settings import Syslog
from appliance.supervisor.role import RemoteReceiver, sender

ROLE = "syslog"


def _receiver(syslog: Syslog) -> RemoteReceiver | None:
    return None if syslog.to is None else RemoteReceiver("audit log's forwarder", *syslog.destination)


FEATURE = Feature(
    settings=Syslog,
    roles=(
        sender(
            ROLE, "rosrv-syslog", "syslog", "appliance.features.syslog.process:main", section=Syslog,
            receiver=_receiver, reads_log=True, ended_early=600,
        ),
    ),
)  # fmt: skip
