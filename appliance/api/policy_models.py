"""What `/v1/policy` takes and gives."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from appliance.api.problems import Finding
from appliance.policy.model import Category

LONGEST_REVISION = 10**15


class Model(BaseModel):
    """What all have in common: nothing that is not named here is taken or given."""

    model_config = ConfigDict(extra="forbid")


class Revision(Model):
    """A policy that came into force; `loaded` is seconds since the epoch."""

    revision: int
    file: str
    loaded: float
    who: str
    note: str
    in_force: bool


class Revisions(Model):
    """The kept revisions, the newest first."""

    revisions: list[Revision]


class RevisionText(Revision):
    """A kept revision with its text."""

    text: str


class PolicyInForce(RevisionText):
    """The policy in force; `confirm_by` (seconds since the epoch) is when it goes back unless confirmed."""

    policy_file: str = Field(description="what `reload` reads")
    differs_from_file: bool
    warnings: list[str]
    confirm_by: float | None


class PolicyText(Model):
    """A new policy."""

    text: str = Field(min_length=1, max_length=1 << 20)
    note: str = Field(default="", max_length=200, description="kept with the revision: why")


class Change(Model):
    """Something that is registered now and would be decided differently."""

    host: str
    caller_id: str
    category: str
    resource: str
    now: Literal["allow", "deny", "would deny"]
    then: Literal["allow", "deny", "would deny"]
    reason: str = Field(description="of the new policy")


class Ended(Model):
    """Something live that the policy ends."""

    host: str
    caller_id: str = Field(description="empty: a client that gave no name")
    what: Literal["publication", "subscription", "service", "call", "parameter"]
    resource: str
    reason: str


class Report(Model):
    """What a new policy does; `loaded` is false after a dry run, and what only a load can tell is then null."""

    loaded: bool
    revision: int = Field(description="in force now")
    replaced: int | None
    revoked: int | None = Field(description="registrations and connections that were taken back")
    confirm_by: float | None
    warnings: list[Finding]
    changes: list[Change]
    ends: list[Ended] = Field(description="what is live and ends by it")


class Loaded(Model):
    """A policy came into force."""

    revision: int
    replaced: int
    warnings: list[str]
    revoked: int
    confirm_by: float | None


class Rollback(Model):
    """Where to go back to; null: the revision before the present one."""

    revision: int | None = Field(default=None, ge=1, le=LONGEST_REVISION, strict=True)


class Confirmed(Model):
    """Whether there was something to confirm."""

    confirmed: bool
    revision: int


class RuleText(Model):
    """Where a rule stands."""

    section: str
    key: str
    file: str
    line: int


class LostRule(Model):
    """A rule that speaks of the resource and does not decide."""

    rule: RuleText
    would: Literal["allow", "deny"]
    why: str


class Explained(Model):
    """Why a request is decided as it is; `node` is the right to the node's name, where that is needed too."""

    host: str
    caller_id: str
    category: str
    resource: str
    decision: Literal["allow", "deny", "would deny"]
    rule: RuleText | None
    reason: str
    told: str | None = Field(description="what the host is told of a denial ([Options] tell); null: allowed")
    through: list[str] = Field(description="the words of the rule that mean the host")
    limit: str = Field(
        description="how much of what is allowed may pass, and by which line of [Limits]; or empty"
    )
    lost: list[LostRule]
    node: "Explained | None" = Field(description="the name that it gives, where a node is needed")
    command: "Explained | None" = Field(description="the command `lookupService`, for a call of a service")
    allowed: bool = Field(description="the answer to the whole call")


class Question(Model):
    """A request to explain; `text`: under this policy instead of the one in force."""

    host: str = Field(min_length=1, max_length=100, description="an address, or `robot`")
    node: str = Field(default="", max_length=256)
    category: Category
    resource: str = Field(min_length=1, max_length=256)
    text: str | None = Field(default=None, max_length=1 << 20)
