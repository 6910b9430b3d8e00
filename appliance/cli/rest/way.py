"""REST as a way to ask the running appliance: the same questions and answers as over its socket."""

from pathlib import Path
from typing import TYPE_CHECKING

from appliance.channel.admin import A, AdminAnswer, AdminRequest, Trouble
from appliance.cli.admin_socket import encoded
from appliance.cli.rest.orders import carry_out
from appliance.cli.rest.session import ProblemError, RestClient

if TYPE_CHECKING:
    from appliance.cli.audit.rest import RestLog


class RestWay:
    """The appliance at a URL."""

    def __init__(self, url: str, token: str | None, authority: Path | None) -> None:
        """Raises ValueError when it is no place to send a token to."""
        self.client = RestClient(url, token, authority)

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Ask one thing. Raises `NotRunningError`."""
        encoded(request)  # what cannot be written over the socket is not asked here either
        try:
            return AdminAnswer(True, carry_out(self.client, request))
        except ProblemError as problem:
            trouble: Trouble = "unknown" if problem.status == 404 else ""
            return AdminAnswer(False, error=problem.lines[0], findings=problem.lines[1:], trouble=trouble)

    def audit(self) -> "RestLog":
        """Its audit log."""
        from appliance.cli.audit.rest import RestLog  # noqa: PLC0415  only for the verbs that read it

        return RestLog(self.client)
