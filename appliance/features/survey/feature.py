"""Define the tool survey. It needs nothing of the appliance, and runs where no appliance is."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Tool

FEATURE = Tool(verbs={"survey": Verb("appliance.features.survey.verb:survey", after="demo")})
