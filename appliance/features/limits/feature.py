"""Define the feature limits. Each part states the use of its own resources."""

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.limits."


FEATURE = Feature(
    verbs={"limits": Verb(f"{_PLACE}verb:limits", after="status")},
)
