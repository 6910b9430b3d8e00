"""Define the feature sign. The core checks the signatures."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

SIGN = Feature("sign", verbs={"sign": Verb("appliance.features.sign.sign_verb:sign", after="monitor")})
