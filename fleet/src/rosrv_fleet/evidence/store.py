"""Store verified evidence bundles as files in `evidence/ID`, where the id is the bundle's SHA-256.

A folder is renamed to its id when both of its files are on the disk. Until then, and while a bundle is removed, it is
in `evidence/incoming`.
"""

import re
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import msgspec
import structlog

from appliance.audit.log.record_format import rfc3339
from appliance.base.atomic_files import write_whole
from rosrv_fleet.robots import make_folder, record_act
from rosrv_fleet.segment_store import DamagedFileError, read_stored, sync

BUNDLE = "bundle.zip"
_ABOUT = "about.json"
_ID = re.compile("[0-9a-f]{64}")
_log = structlog.get_logger()


class EvidenceContent(msgspec.Struct, frozen=True, kw_only=True):
    """The verified content of an evidence bundle. Times are nanoseconds since the epoch.

    `collected` is the number of its `checkpoints` that are also in the robot's collected segments. `unproven` lists
    facts that the robot's log does not prove.
    """

    log: str
    since: int
    until: int
    recording: str
    records: int
    checkpoints: int
    collected: int
    unproven: list[str]


class StoredEvidence(EvidenceContent, frozen=True, kw_only=True):
    """A stored bundle of `robot`, added by the operator `by`."""

    id: str
    robot: str
    bytes: int
    added: int
    by: str

    def has(self, record: Mapping[str, object]) -> bool:
        is_same_log = self.robot == record["robot"] and self.log == record["log"]
        return is_same_log and rfc3339(self.since) <= str(record["time"]) < rfc3339(self.until)


class EvidenceStore:
    """The evidence bundles in a folder. Thread-safe, but only one process may add bundles."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, StoredEvidence] = {}
        self._damaged: set[str] = set()
        make_folder(folder / "incoming")

    def remove_unfinished(self) -> None:
        for upload in (self._folder / "incoming").iterdir():
            shutil.rmtree(upload)

    def incoming(self) -> Path:
        """Return a new folder for the file `BUNDLE`. The caller removes it unless `keep` was called."""
        return Path(tempfile.mkdtemp(dir=self._folder / "incoming"))

    def keep(self, upload: Path, about: StoredEvidence) -> None:
        """Record the act and store the bundle durably."""
        bundle = upload / BUNDLE
        bundle.chmod(0o400)
        sync(bundle)
        write_whole(upload / _ABOUT, msgspec.json.encode(about), 0o400)
        with record_act(self._folder.parent, "evidence add", about.robot, about.id, about.by):
            upload.rename(self._folder / about.id)
            sync(self._folder)

    def remove(self, evidence: str) -> StoredEvidence | None:
        about = self.get(evidence) if _ID.fullmatch(evidence) else None
        if about is not None:
            removed = self.incoming()  # a killed command leaves it there
            with record_act(self._folder.parent, "evidence remove", about.robot, evidence):
                (self._folder / evidence).rename(removed / evidence)
                sync(self._folder)
            shutil.rmtree(removed)
        return about

    def path(self, evidence: str) -> Path:
        return self._folder / evidence / BUNDLE

    def get(self, evidence: str) -> StoredEvidence | None:
        try:
            return read_stored(self._folder / evidence / _ABOUT, StoredEvidence)
        except FileNotFoundError:
            return None

    def all(self, robot: str = "") -> list[StoredEvidence]:
        """Return the bundles of a robot or of all, latest first. Damaged ones are left out, and logged once."""
        names = {path.name for path in self._folder.iterdir() if _ID.fullmatch(path.name)}
        for name in names - self._known.keys():
            try:
                if (found := self.get(name)) is not None:
                    self._known[name] = found
            except DamagedFileError as error:
                if name not in self._damaged:
                    _log.error("an evidence bundle is not listed", reason=str(error))
                    self._damaged.add(name)
        known = (self._known[name] for name in names & self._known.keys())
        return sorted((one for one in known if robot in ("", one.robot)), key=lambda one: -one.added)
