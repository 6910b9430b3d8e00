"""The error that stops the appliance."""

from appliance.base.user_errors import UserError


class StartError(UserError):
    """Report that the appliance cannot start or go on; the message has the cause, the place and the remedy."""
