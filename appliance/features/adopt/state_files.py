"""Name the files of an adoption that may exist in the state directory before the first start."""

STATE_FILES = ("adopt.json",)
