"""The errors that stop the appliance."""

from appliance.base.user_errors import UserError


class StartError(UserError):
    """The appliance cannot start."""


class PortInUseError(StartError):
    """Another program uses a port of the appliance; when it ends, the appliance can start."""
