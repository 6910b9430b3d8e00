"""What `/v1/monitors` takes and gives."""

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from appliance.api.problems import Finding

LONGEST_TEXT = 1 << 20
Name = Annotated[str, StringConstraints(min_length=1, max_length=256)]
FileName = Annotated[
    str, StringConstraints(max_length=200, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,190}\.rv$")
]
Definition = Annotated[
    str,
    StringConstraints(max_length=200, pattern=r"^[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*\.(msg|srv)$"),
]
Text = Annotated[str, StringConstraints(max_length=LONGEST_TEXT)]
_DEFINITIONS: dict[Definition, Text] = Field(
    default={},
    max_length=1000,
    description="definitions of messages and services that ROS does not ship, by `package/Type.msg`",
)
_TAG = Field(
    description="another after every change, switch and resumption; in quotes it is the ETag, and what If-Match takes"
)
_NOTE = Field(default="", max_length=200, description="kept with the revision: why")


class Model(BaseModel):
    """What all have in common: nothing that is not named here is taken or given."""

    model_config = ConfigDict(extra="forbid")


class MonitorState(Model):
    """A running monitor; counters since it was loaded or its relay began."""

    name: str
    file: str = Field(description="the specification file it stands in; a file may have several monitors")
    enabled: bool
    held: bool = Field(description="blocks its topics until it is resumed")
    failing: bool
    topics: list[str]
    services: list[str]
    events: int
    verdicts: int
    drops: int
    changes: int
    faults: int


class Monitors(Model):
    """The specifications in force; `loaded` is seconds since the epoch."""

    revision: int
    tag: str = _TAG
    who: str
    note: str
    loaded: float
    folder: str | None = Field(description="what `reload` reads; null: no folder was given at start")
    differs_from_folder: bool
    warnings: list[str]
    refused: list[str] = Field(description="why the relay does not take them: everything is blocked then")
    rv_state: list[Any] = Field(
        description="ROSRV's `getRVState`: ROSMaster's port, RVMaster's, and where topics are carried"
    )
    monitors: list[MonitorState] = Field(description="in the order in which they see messages")
    files: dict[str, str] | None = Field(
        default=None, description="with `texts=1`: specifications by file name"
    )
    definitions: dict[str, str] | None = Field(
        default=None, description="with `texts=1`: those that came with them"
    )


class EventShown(Model):
    """An event of a specification: on a topic, in a service's request or response, or `every` so many seconds."""

    name: str
    line: int
    topic: str | None
    type: str | None
    part: str | None = Field(description="of a service: request or response")
    every: float | None


class PropertyShown(Model):
    """A property of a specification; `drawn`: `…/picture` shows its automaton."""

    logic: str
    formula: str
    categories: list[str]
    handled: list[str]
    drawn: bool


class Happened(Model):
    """Something a monitor did, as it is in the audit log under this sequence; `count`: more of the same."""

    sequence: int
    time: str
    event: str
    resource: str | None
    reason: str
    category: str | None = Field(description="of a verdict")
    count: int | None


class Monitor(MonitorState):
    """A monitor with the text it was made of."""

    revision: int
    tag: str = _TAG
    text: str = Field(description="of its whole file")
    alphabet: list[EventShown] = Field(description="its events")
    properties: list[PropertyShown]
    warnings: list[Finding] = Field(description="of its file")
    uses: list[str] = Field(description="monitors whose variables it uses")
    hold: bool = Field(description="declared `hold`: blocks its topics after a restart of the relay")


class History(Model):
    """What a monitor did last, the newest first."""

    name: str
    happened: list[Happened]
    cursor: str | None = Field(description="of the next page; null: there is none")


class NewSpecifications(Model):
    """Specifications to add, or to put in the place of those in files of the same name."""

    files: dict[FileName, Text] = Field(
        min_length=1, max_length=1000, description="texts by the name of the file"
    )
    definitions: dict[Definition, Text] = _DEFINITIONS
    note: str = _NOTE


class NewText(Model):
    """The new text of the file that a monitor stands in."""

    text: str = Field(min_length=1, max_length=LONGEST_TEXT)
    definitions: dict[Definition, Text] = _DEFINITIONS
    note: str = _NOTE


class Replaced(Model):
    """What a change did, or after a dry run (`loaded` false) would do; `replaced` is the revision before."""

    loaded: bool
    revision: int = Field(description="in force now")
    tag: str = _TAG
    replaced: int | None
    added: list[str]
    changed: list[str]
    removed: list[str]
    warnings: list[Finding]
    monitors: list[str] = Field(description="those that there are (would be), in order")
    moved: list[str] = Field(
        default=[], description="monitors that began anew because another relay process has them now"
    )
    began: list[str] = Field(
        default=[],
        description="all monitors that are in their initial state by this change, new ones among them",
    )
    kept: list[str] = Field(
        default=[],
        description="files that a reload left in force although the folder does not have them: loaded from elsewhere",
    )


class Switch(Model):
    """What is to become of a monitor: exactly one of both."""

    enabled: bool | None = Field(default=None, strict=True)
    held: bool | None = Field(default=None, strict=True, description="false: let its topics go on")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.enabled is None) is (self.held is None) or self.held is True:
            raise ValueError("either `enabled` (true or false), or `held` (false)")
        return self


class SwitchMany(Switch):
    """The same for several monitors at once: all of them, or none when there is an unknown name."""

    names: list[Name] = Field(min_length=1, max_length=1000)


class Switched(Model):
    """The monitors that were not so already."""

    revision: int
    tag: str = _TAG
    names: list[str]
