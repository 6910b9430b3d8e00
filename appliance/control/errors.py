"""Define the errors of requests that cannot be answered, and of a state that cannot be used."""

from collections.abc import Sequence


class UnknownThingError(Exception):
    """The requested name or number does not exist."""


class SenselessError(Exception):
    """The request is well-formed, but cannot be carried out as it is; the message says why."""


class UnavailableError(Exception):
    """The appliance cannot do it now; the message gives the reason."""


class StateError(Exception):
    """A file of the state cannot be used; the message names the file, the reason and the remedy."""


class TokenRefusedError(Exception):
    """The token cannot be made or revoked; the message gives the reason."""


class PolicyRefusedError(Exception):
    """The policy is rejected; `findings` has every reason, as `file:line:column: error: text`."""

    def __init__(self, findings: Sequence[str]) -> None:
        super().__init__("\n".join(findings))
        self.findings = list(findings)
