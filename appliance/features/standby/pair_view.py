"""The views of two appliances. A method imports what only one command needs."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.features.standby.answers import StandbyState
from appliance.features.standby.requests import StandbyWanted
from appliance.features.standby.samples import samples_of
from appliance.features.view import PairView, Samples

if TYPE_CHECKING:
    from appliance.audit.proof.chain_findings import Verification


class StandbyPairView(PairView):
    """A standby pair in status, alarms and metrics."""

    def request(self) -> StandbyWanted:
        return StandbyWanted()

    def samples(self, state: StandbyState) -> Mapping[str, Samples]:
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

        pair = takeover_table.verified_pair(own, verified, other, state, verify)
        return pair, takeover_table.print_pair
