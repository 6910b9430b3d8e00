"""Edit the operator's repository of bundles: delegate groups, add and withdraw bundles, sign, rotate keys.

Each group has a delegated role with its own path pattern, so the holder of its key cannot sign for another group.
Only the timestamp key is online, because it signs every few hours. A thief of that key can freeze the fleet until the
snapshot expires, but cannot mix versions.

Metadata files never change: each version is a new file, and the snapshot is written last. So a killed command leaves
the former state, and the next command completes it.
"""

import datetime
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from securesystemslib.signer import CryptoSigner, Key
from tuf.api.metadata import (
    DelegatedRole,
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Snapshot,
    TargetFile,
    Targets,
)
from tuf.api.serialization.json import JSONSerializer

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.formats.bundle_archive import pack
from appliance.formats.terms import BundlePath, Terms, custom_of, role_of

# Keep the signing keys of bundles as encrypted PEM files, each with one Ed25519 key, named by role and key id.

_FILE = re.compile(r"(.+)\.([0-9a-f]{16})\.pem")
_ID_DIGITS = 16
_SHORTEST = 8


class KeyFileError(Exception):
    """A key cannot be read or made."""


class KeyFolder:
    """The folder of key files. It asks for each passphrase once."""

    def __init__(self, folder: Path, passphrase: Callable[[Path], str]) -> None:
        self.folder = folder
        self._passphrase = passphrase
        self._signers: dict[Path, CryptoSigner] = {}

    def make(self, role: str) -> Key:
        signer = CryptoSigner.generate_ed25519()
        path = self.folder / f"{role}.{signer.public_key.keyid[:_ID_DIGITS]}.pem"
        passphrase = self._passphrase(path)
        if len(passphrase) < _SHORTEST:
            raise KeyFileError(f"the passphrase of {path.name} must have at least {_SHORTEST} characters")
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(path, _pem(signer, passphrase), 0o600)
        self._signers[path] = signer
        return signer.public_key

    def signers(self, role: str, keyids: Collection[str]) -> list[CryptoSigner]:
        """Return the role's keys with these ids. Raises `KeyFileError` if the role has none of them."""
        signers = []
        for path in sorted(self.folder.glob("*.pem")):
            name = _FILE.fullmatch(path.name)
            if name is not None and name[1] == role and any(keyid.startswith(name[2]) for keyid in keyids):
                signers.append(self._load(path))
        if not signers:
            raise KeyFileError(
                f"{self.folder} has no key of role {role}: give its folder with --keys{_if_lost(role)}"
            )
        return signers

    def _load(self, path: Path) -> CryptoSigner:
        if path not in self._signers:
            try:
                key = load_pem_private_key(path.read_bytes(), self._passphrase(path).encode())
            except (ValueError, TypeError) as error:
                raise KeyFileError(f"{path}: the passphrase is wrong, or the file is damaged") from error
            if not isinstance(key, Ed25519PrivateKey):
                raise KeyFileError(f"{path} is not an Ed25519 key")
            self._signers[path] = CryptoSigner(key)
        return self._signers[path]


def _if_lost(role: str) -> str:
    if role == "root":
        return "; if it is lost, make a new repository, and give its root.json to the robots"
    return f"; if it is lost: rosrv-fleet bundle rotate {role}"


def make_online_key(path: Path) -> Key:
    signer = CryptoSigner.generate_ed25519()
    write_whole(path, _pem(signer, None), 0o600)
    return signer.public_key


def load_online_key(path: Path) -> CryptoSigner:
    try:
        key = load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        advice = f"copy it from the repository{_if_lost('timestamp')}"
        raise KeyFileError(f"{path}: the timestamp key cannot be read: {error}; {advice}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(f"{path} is not an Ed25519 key")
    return CryptoSigner(key)


def _pem(signer: CryptoSigner, passphrase: str | None) -> bytes:
    key = load_pem_private_key(signer.private_bytes, None)
    encryption = NoEncryption() if passphrase is None else BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)


TIMESTAMP_KEY = "timestamp.pem"
KEPT = 3  # signed bundles of a group: the last good one, a bad one, and its correction
_TOP = ("root", "targets", "snapshot", "timestamp")
_VERSIONED = re.compile(r"([1-9][0-9]*)\.(.+)\.json")
S = TypeVar("S", Root, Targets, Snapshot)


def _utc_now() -> datetime.datetime:
    return clock.utc_now().replace(microsecond=0)


class RepositoryError(Exception):
    """The repository does not allow this change."""


@dataclass(frozen=True, slots=True)
class Lifetimes:
    """The number of days until metadata of each kind expire."""

    root: int = 365
    targets: int = 180
    group: int = 90
    snapshot: int = 60


class BundleRepository:
    """A repository in a folder, and the keys that sign it. Its methods raise `RepositoryError`."""

    def __init__(
        self,
        folder: Path,
        keys: KeyFolder,
        lifetimes: Lifetimes | None = None,
        now: Callable[[], datetime.datetime] = _utc_now,
    ) -> None:
        self.folder = folder
        self.metadata = folder / "metadata"
        self.targets = folder / "targets"
        self.keys = keys
        self._lifetimes = lifetimes or Lifetimes()
        self.now = now

    # --- commands ---

    def init(self) -> None:
        """Make the keys and the first metadata. The root comes last: without it, the folder is not a repository."""
        if self._newest("root"):
            raise RepositoryError(f"{self.folder} has a repository: use it, or choose another folder")
        root = Root(consistent_snapshot=True)
        for role in ("root", "targets", "snapshot"):
            root.add_key(self.keys.make(role), role)
        self.metadata.mkdir(parents=True, exist_ok=True)
        root.add_key(make_online_key(self.folder / TIMESTAMP_KEY), "timestamp")
        targets = Targets()
        targets.delegations = Delegations({}, {})
        self._save("targets", targets, root.roles["targets"].keyids)
        self.snapshot(root.roles["snapshot"].keyids)
        self._save_root(root, root)

    def delegate(self, site: str, group: str) -> None:
        role = role_of(site, group)
        top = self._open("targets", Targets)
        if role in self._delegated_roles(top):
            raise RepositoryError(
                f"{role} is delegated already; rotate its key with `rosrv-fleet bundle rotate`"
            )
        delegated = DelegatedRole(role, [], 1, terminating=True, paths=[f"{site}/{group}/*.tar"])
        assert top.delegations is not None and top.delegations.roles is not None  # noqa: S101  made by `init`
        top.delegations.roles[role] = delegated
        key = self.keys.make(role)
        top.add_key(key, role)
        self._save(
            role, Targets(), [key.keyid]
        )  # before it is delegated, so that each delegated role has metadata
        self._save("targets", top)
        self.snapshot()

    def add(
        self, site: str, group: str, files: Mapping[str, bytes], terms: Terms, *, keep: int = KEPT
    ) -> BundlePath:
        """Sign a bundle of these files as the next version of a group, and withdraw all but the newest `keep`.

        Also raise `TermsError` and `BundleArchiveError`.
        """
        role = self._require_role(site, group)
        listed = self._open(role, Targets)
        path = BundlePath(site, group, 1 + max([*self._versions(listed), self._last_version(site, group)]))
        archive = pack(files)
        target = TargetFile.from_data(str(path), archive, ["sha256"])
        target.unrecognized_fields["custom"] = custom_of(terms)
        (self.targets / site / group).mkdir(parents=True, exist_ok=True)
        for name in target.get_prefixed_paths():
            write_whole(self.targets / name, archive, 0o644)
        listed.targets[str(path)] = target
        for version in sorted(self._versions(listed))[: -max(1, keep)]:
            del listed.targets[str(path._replace(version=version))]
        self._save(role, listed)
        self.snapshot()
        return path

    def withdraw(self, path: BundlePath) -> None:
        role = self._require_role(path.site, path.group)
        listed = self._open(role, Targets)
        if str(path) not in listed.targets:
            known = ", ".join(listed.targets) or "none"
            raise RepositoryError(f"{path} is not signed; signed are: {known}")
        del listed.targets[str(path)]
        self._save(role, listed)
        self.snapshot()

    def sign(self) -> None:
        for role in ("targets", *self.roles()):
            self._save(role, self._open(role, Targets))
        self.snapshot()

    def rotate(self, role: str) -> None:
        """Replace the key of a role.

        A new root key is signed with the old one. After a new snapshot or timestamp key, robots discard the metadata
        of the old key, and so recover from versions that a thief set too high.
        """
        if role in _TOP:
            before = self._open("root", Root)
            root = self._open("root", Root)
            key = (
                make_online_key(self.folder / TIMESTAMP_KEY) if role == "timestamp" else self.keys.make(role)
            )
            for keyid in list(root.roles[role].keyids):
                root.revoke_key(keyid, role)
            root.add_key(key, role)
            self._save_root(root, before)
        elif role in self.roles():
            top = self._open("targets", Targets)
            for keyid in list(self._delegated_roles(top)[role].keyids):
                top.revoke_key(keyid, role)
            top.add_key(self.keys.make(role), role)
            self._save("targets", top)
            self._save(role, self._open(role, Targets))
        else:
            raise RepositoryError(f"{role} is not a role; there are: {', '.join([*_TOP, *self.roles()])}")
        if role == "targets":
            self._save(role, self._open(role, Targets))
        self.snapshot()

    def renew_root(self) -> None:
        root = self._open("root", Root)
        self._save_root(root, root)

    # --- queries ---

    def roles(self) -> list[str]:
        return sorted(self._delegated_roles(self._open("targets", Targets)))

    def bundles(self) -> Iterator[tuple[BundlePath, TargetFile]]:
        for role in self.roles():
            for name, target in self._open(role, Targets).targets.items():
                yield BundlePath.parse(name), target

    def expiries(self) -> dict[str, datetime.datetime]:
        found = {
            "root": self._open("root", Root).expires,
            "snapshot": self._open("snapshot", Snapshot).expires,
        }
        return found | {role: self._open(role, Targets).expires for role in ("targets", *self.roles())}

    # --- signing ---

    def snapshot(self, keyids: Iterable[str] | None = None) -> None:
        try:
            snapshot = self._open("snapshot", Snapshot)
        except RepositoryError:
            snapshot = Snapshot()
        snapshot.meta = {f"{role}.json": MetaFile(self._newest(role)) for role in ("targets", *self.roles())}
        self._save("snapshot", snapshot, keyids)

    def _save_root(self, root: Root, before: Root) -> None:
        """Sign a root with its own keys and those of the root before it. Write `root.json` for new robots."""
        keyids = {*before.roles["root"].keyids, *root.roles["root"].keyids}
        path = self._save("root", root, keyids)
        write_whole(self.folder / "root.json", path.read_bytes(), 0o644)

    def _save(
        self, role: str, signed: Root | Targets | Snapshot, keyids: Iterable[str] | None = None
    ) -> Path:
        signed.version = 1 + self._newest(role)
        signed.expires = self.now() + datetime.timedelta(days=self._days(role))
        document: Metadata[Any] = Metadata(signed)
        wanted = set(self.keyids_of(role) if keyids is None else keyids)
        for signer in self.keys.signers(role, wanted):
            document.sign(signer, append=True)
        path = self.metadata / f"{signed.version}.{role}.json"
        write_whole(path, document.to_bytes(JSONSerializer(compact=False)), 0o644)
        return path

    def _days(self, role: str) -> int:
        days = self._lifetimes
        return {"root": days.root, "targets": days.targets, "snapshot": days.snapshot}.get(role, days.group)

    def keyids_of(self, role: str) -> list[str]:
        if role in _TOP:
            return list(self._open("root", Root).roles[role].keyids)
        return list(self._delegated_roles(self._open("targets", Targets))[role].keyids)

    # --- reading ---

    def _open(self, role: str, kind: type[S]) -> S:
        version = self._newest(role)
        if not version:
            raise RepositoryError(f"{self.folder} is not a repository of bundles: rosrv-fleet bundle init")
        signed = Metadata.from_file(str(self.metadata / f"{version}.{role}.json")).signed
        if not isinstance(signed, kind):
            raise RepositoryError(f"{version}.{role}.json contains metadata of another role or version")
        return signed

    def _newest(self, role: str) -> int:
        names = (_VERSIONED.fullmatch(path.name) for path in self.metadata.glob("*.json"))
        return max((int(name[1]) for name in names if name is not None and name[2] == role), default=0)

    def _delegated_roles(self, top: Targets) -> Mapping[str, DelegatedRole]:
        return {} if top.delegations is None or top.delegations.roles is None else top.delegations.roles

    def _require_role(self, site: str, group: str) -> str:
        role = role_of(site, group)
        if role not in self.roles():
            raise RepositoryError(f"{role} is not delegated: rosrv-fleet bundle delegate {site}/{group}")
        return role

    def _versions(self, listed: Targets) -> list[int]:
        return [BundlePath.parse(name).version for name in listed.targets]

    def _last_version(self, site: str, group: str) -> int:
        """Return the highest version, including withdrawn ones, so that no version is used twice."""
        names = (path.name.split(".")[1] for path in (self.targets / site / group).glob("*.tar"))
        return max(map(int, names), default=0)
