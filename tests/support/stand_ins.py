"""Stand-ins that many tests need, typed as what they stand for."""

from appliance.master.graph.registry import Incarnation, Kind, Registration


class NoJournal:
    """A registry's `Journal` that keeps nothing."""

    def incarnation_saved(self, incarnation: Incarnation) -> None:
        """Forgotten."""

    def incarnation_forgotten(self, key: str) -> None:
        """As it is."""

    def registration_saved(self, key: str, registration: Registration) -> None:
        """Forgotten."""

    def registration_removed(self, key: str, kind: Kind, resource: str) -> None:
        """As it is."""

    def registration_shelved(self, key: str, registration: Registration) -> None:
        """Forgotten."""

    def registration_unshelved(self, key: str, kind: Kind, resource: str) -> None:
        """As it is."""
