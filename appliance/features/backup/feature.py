"""Define the tool backup."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Tool

_VERBS = "appliance.features.backup.backup_verbs"

FEATURE = Tool(
    verbs={
        "backup": Verb(f"{_VERBS}:backup", after="certificate"),
        "restore": Verb(f"{_VERBS}:restore", after="backup"),
        "purge": Verb(f"{_VERBS}:purge", after="restore"),
    },
)
