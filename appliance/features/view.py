"""Define what a feature adds to views of commands and pages, without settings: `rosrv status` must start fast."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from appliance.base.user_errors import UserError

if TYPE_CHECKING:
    from appliance.audit.proof.chain_findings import Verification
    from appliance.channel.answers.standby_answers import StandbyState

Samples = Iterable[tuple[tuple[str, ...], Any]]
"""The samples of a metric: values of its labels, and the value."""


class Trouble(NamedTuple):
    """A condition that needs attention; `text` has the reason and what to do."""

    severity: Literal["alarm", "warning"]
    kind: str
    text: str


class PairView:
    """The views of two appliances; this class is for a product without pairs."""

    def alarms(self, state: "StandbyState") -> Iterable[Trouble]:
        """Return what is wrong and lasts."""
        del state
        return ()

    def samples(self, state: "StandbyState") -> Mapping[str, Samples]:
        del state
        return {}

    def line(self, state: "StandbyState") -> Any:
        return state.role

    def status(self, state: "StandbyState") -> Any:
        """Return the `StatusView` of an appliance that waits for the other one to end."""
        raise UserError(
            f"{state.name} is one of two appliances, which this rosrv cannot show: use one with `standby`"
        )

    def verify(
        self,
        own: Path,
        verified: "Verification",
        other: Path,
        state: Path,
        verify: "Callable[[], Verification]",
    ) -> tuple[Any, Callable[[Any], None]]:
        """Verify the log `own`, which is `verified`, and the log `other` in a state directory, with `verify()`.

        Return the result, and the function that prints it.
        """
        del verified, state, verify
        raise UserError(f"{own} and {other}: this rosrv cannot verify takeovers: use one with `standby`")


@dataclass(frozen=True)
class FeatureView:
    """A class of `PairView` (`module:name`), for the feature that makes pairs."""

    name: str
    pair: str
