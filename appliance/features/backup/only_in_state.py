"""Find the specifications in force that are only in a state directory, not in the folder of the configuration."""

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import msgspec

from appliance.base.input_files import read_given_text
from appliance.configuration.settings import load_resolved
from rosmop.form.switch_words import without_file_switch

_STATE = "control/state.db"


class _Stored(msgspec.Struct, frozen=True):
    """The part of a stored revision that is compared."""

    files: dict[str, str] = {}


_LAST = "SELECT sources FROM monitor_revision ORDER BY revision DESC LIMIT 1"


def specifications_in(name: str, copy: Path) -> Mapping[str, str]:
    """Return the texts in force, by file, if the archived file of this name is the state. Raises `sqlite3.Error`."""
    if name != _STATE:
        return {}
    with closing(sqlite3.connect(f"{copy.as_uri()}?mode=ro", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'monitor_revision'").fetchone():
            return {}
        row = database.execute(_LAST).fetchone()
    return msgspec.json.decode(row[0], type=_Stored).files if row else {}


def lacking_in_folder(state: Path, texts: Mapping[str, str]) -> list[str]:
    """Return the files whose texts are not in the folder that the appliance of this state last used."""
    try:
        folder = load_resolved(state / "run" / "config.json").monitors
    except (OSError, ValueError):
        folder = None  # the appliance has not started with this state
    return [file for file, text in texts.items() if not _has(folder, file, text)]


def _has(folder: Path | None, file: str, text: str) -> bool:
    try:
        there = "" if folder is None else read_given_text(folder / file, "utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return False
    return without_file_switch(there) == without_file_switch(text)
