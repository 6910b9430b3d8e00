"""Define the tool monitor tools."""

from appliance.cli.verb_table import CONFIRM, Group, Verb
from appliance.features.feature import Tool
from rosmop.tool.summaries import SUMMARIES

_PLACE = "appliance.features.monitor_tools."
_LANGUAGE, _LIVE, _REVISIONS = f"{_PLACE}verbs", f"{_PLACE}in_force", f"{_PLACE}revision_verbs"

FEATURE = Tool(
    verbs={
        "monitor": Group(
            "Check specifications, test them on recordings, and run them as monitors on the robot.",
            {
                "check": Verb(f"{_LANGUAGE}:check", SUMMARIES["check"]),
                "run": Verb(f"{_LANGUAGE}:run", SUMMARIES["run"]),
                "learn": Verb(f"{_LANGUAGE}:learn", SUMMARIES["learn"]),
                "replay": Verb(f"{_PLACE}replay:replay_monitor"),
                "coverage": Verb(f"{_LANGUAGE}:coverage", SUMMARIES["coverage"]),
                "list": Verb(f"{_LIVE}:list_monitors"),
                "enable": Verb(f"{_LIVE}:enable"),
                "enforce": Verb(f"{_LIVE}:enforce"),
                "disable": Verb(f"{_LIVE}:disable"),
                "load": Verb(f"{_PLACE}load_verb:load"),
                "remove": Verb(f"{_LIVE}:remove"),
                "reload": Verb(f"{_LIVE}:reload"),
                "revisions": Verb(
                    f"{_REVISIONS}:revisions", "List the kept revisions of the specifications, newest first."
                ),
                "show": Verb(f"{_REVISIONS}:show"),
                "diff": Verb(f"{_REVISIONS}:diff"),
                "rollback": Verb(
                    f"{_REVISIONS}:rollback",
                    "Return to an earlier revision of the specifications and enable or disable monitors as they were"
                    " then.",
                ),
                "confirm": Verb(f"{_REVISIONS}:confirm", CONFIRM),
                "resume": Verb(f"{_LIVE}:resume"),
                "set": Verb(f"{_LIVE}:set_given"),
                "reset": Verb(f"{_PLACE}reset_verb:reset"),
                "rvstate": Verb(f"{_LIVE}:rv_state", hidden=True),
            },
            after="policy",
        )
    },
)
