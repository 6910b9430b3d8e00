"""The error that stops the appliance."""

from appliance.base.user_errors import UserError


class StartError(UserError):
    """The appliance cannot start."""
