"""Errors of a sign-on, by who is at fault. Each text reaches the person and the audit log."""


class SignOnRefusedError(Exception):
    """The person, the browser or the ID token is not accepted."""


class ProviderError(Exception):
    """The provider does not answer, or its answer cannot be used."""
