"""Define what the appliance answers about an adoption."""

from typing import Annotated, Literal

import msgspec

from appliance.base.counted import counted
from appliance.channel.answers.field_docs import doc


class AdoptState(msgspec.Struct, frozen=True):
    """The adoption of the robot's graph, or null without one."""

    phase: Annotated[
        Literal["free", "taking", "taken", "giving", "given"],
        doc(
            "`taken`: the robot's nodes use the appliance; `free`: their own master; the others are on the way"
        ),
    ]
    wanted: Annotated[bool, doc("whether an operator wants the graph adopted")]
    since_utc: Annotated[str, doc("when the adoption was ordered")]
    master: Annotated[str, doc("the robot's own master, which was recorded")]
    present: Annotated[bool, doc("whether that master runs; without it, a release starts another one")]
    obstacle: Annotated[str, doc("why the graph is not as wanted; empty if it is")]
    nodes: Annotated[int, doc("nodes of the robot that answer, with a registration")]
    not_started: Annotated[
        int, doc("adopted nodes that have not started since, so their start was never seen")
    ]
    denied: Annotated[dict[str, str], doc("registrations that were denied, with the reasons")]
    missing: Annotated[dict[str, str], doc("nodes that were left with their own master, with the reasons")]
    not_cut: Annotated[
        dict[str, str],
        doc(
            "ports and nodes whose connections were not cut, or not known to have ended, with the reasons; until the"
            " program is restarted, what it publishes may bypass the appliance"
        ),
    ] = {}


class TakeOverReport(msgspec.Struct, frozen=True):
    """The result of an adoption, for the operator."""

    nodes: int = 0
    hosts: list[str] = []
    registrations: int = 0
    denied: dict[str, str] = {}
    missing: dict[str, str] = {}
    not_cut: dict[str, str] = {}
    cut: int = 0
    readings: int = 0
    left_out: list[str] = []
    seconds: float = 0.0


class GiveBackReport(msgspec.Struct, frozen=True):
    """The result of giving the graph back.

    `withheld` counts registrations that no master got, because the one on the robot's port is another one than the
    recorded one (`withheld_from`).
    """

    nodes: int = 0
    given: int = 0
    ended: int = 0
    parameters: int = 0
    master: str = ""
    started: bool = False
    failed: list[str] = []
    withheld: int = 0
    withheld_from: str = ""
    seconds: float = 0.0

    @property
    def in_words(self) -> str:
        """Which master the nodes use now."""
        master = self.master or "the robot's own master"
        return f"{counted(self.nodes, 'node uses', 'nodes use')} {master} again"
