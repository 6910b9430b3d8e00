"""Choose how a verb reads the audit log of its appliance: from the file, or over REST."""

from typing import TYPE_CHECKING

from appliance.cli.connection.admin_client import AdminSocket
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_over_rest import RestLog

if TYPE_CHECKING:
    from appliance.cli.connection.rest_orders import RestWay


AuditSource = FileLog | RestLog
"""The two have the same methods."""


def audit_of(way: "AdminSocket | RestWay") -> AuditSource:
    return FileLog(way.state, way.robot_name) if isinstance(way, AdminSocket) else RestLog(way.client)
