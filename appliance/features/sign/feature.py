"""Define the tool sign. The core checks the signatures."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Tool

FEATURE = Tool(verbs={"sign": Verb("appliance.features.sign.verb:sign", after="monitor")})
