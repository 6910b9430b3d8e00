"""Define the tool selftest."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Tool

FEATURE = Tool(
    verbs={"selftest": Verb("appliance.features.selftest.verb:selftest", after="limits")},
)
