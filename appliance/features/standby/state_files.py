"""Name the files of a pair that may exist in the state directory before the first start."""

from appliance.features.standby.membership import FILE, FOLDER, LEFT_FILE

STATE_FILES = (f"{FOLDER}/{FILE}", f"{FOLDER}/{LEFT_FILE}")
