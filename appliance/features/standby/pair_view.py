"""The views of two appliances. Each method imports its view, which only one process or command needs."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.features.standby.standby_answers import StandbyState
from appliance.features.view import PairView, Samples

if TYPE_CHECKING:
    from appliance.audit.proof.chain_findings import Verification
    from appliance.features.standby.requests import StandbyWanted


class StandbyPairView(PairView):
    """The views of an appliance that can be one of two."""

    def request(self) -> "StandbyWanted":
        from appliance.features.standby.requests import StandbyWanted  # noqa: PLC0415  it imports the views

        return StandbyWanted()

    def samples(self, state: StandbyState) -> Mapping[str, Samples]:
        from appliance.features.standby.samples import samples_of  # noqa: PLC0415  only the api needs it

        return samples_of(state)

    def status(self, state: StandbyState) -> Any:
        from appliance.features.standby.standby_view import standby_view  # noqa: PLC0415  only the command needs it

        return standby_view(state)

    def verify(
        self,
        own: Path,
        verified: "Verification",
        other: Path,
        state: Path,
        verify: "Callable[[], Verification]",
    ) -> tuple[Any, Callable[[Any], None]]:
        from appliance.features.standby import takeover_table  # noqa: PLC0415  only one command needs it
        from appliance.features.standby.takeover_verification import (  # noqa: PLC0415  as above
            VerifiedLog,
            verify_alone,
            verify_takeovers,
        )

        first = VerifiedLog(own, verified)
        absent = takeover_table.absent(other, state)
        pair = (
            verify_alone(first, absent) if absent else verify_takeovers(first, VerifiedLog(other, verify()))
        )
        return pair, takeover_table.print_pair
