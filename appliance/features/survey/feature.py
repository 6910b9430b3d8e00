"""Define the feature survey. It needs nothing of the appliance, and runs where no appliance is."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

SURVEY = Feature(
    "survey", verbs={"survey": Verb("appliance.features.survey.survey_verb:survey", after="demo")}
)
