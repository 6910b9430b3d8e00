"""`rosrv-fleet bundle`: make, sign, withdraw and publish bundles on the operator's machine."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.atomic_files import write_whole
from appliance.base.counted import counted
from appliance.base.input_files import files_below, read_given
from appliance.formats.bundle_archive import (
    LONGEST,
    BundleArchiveError,
    BundleContents,
    contents_of,
    is_bundle_file,
)
from appliance.formats.terms import BundlePath, Ring, Terms, TermsError, terms_of
from rosrv_fleet.bundles.publication import PublicationError, read_publication
from rosrv_fleet.bundles.repository import KEPT, BundleRepository, KeyFileError, KeyFolder, RepositoryError
from rosrv_fleet.output import say

bundle = typer.Typer(help="Make, sign and publish bundles on the operator's machine.", no_args_is_help=True)

_RING = re.compile(r"([a-z0-9-]+)=(?:([0-9]{1,3})%|([A-Za-z0-9._,-]+))(?:\+([0-9]+)([smhd]))?")
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}

Repository = Annotated[Path, typer.Option("--repository", metavar="DIR", help="The repository of bundles")]
Keys = Annotated[
    Path | None, typer.Option("--keys", metavar="DIR", help="The folder of the keys (default: DIR/keys)")
]
Secret = Annotated[
    Path | None,
    typer.Option("--passphrase-file", metavar="FILE", help="A file whose first line is the passphrase"),
]
Place = Annotated[str, typer.Argument(metavar="SITE/GROUP", help="The site and the robot group")]
_HERE = Path()


@bundle.command()
def init(repository: Repository = _HERE, keys: Keys = None, passphrase_file: Secret = None) -> None:
    """Make a repository with encrypted keys for root, targets and snapshot, and the collector's timestamp key.

    Give `root.json` to the robots (fleet.bundles.root) and `timestamp.pem` to the collector. Keep the keys offline.

    Example: rosrv-fleet bundle init --repository bundles
    """
    with _open(repository, keys, passphrase_file) as made:
        made.init()
        say(f"{repository}: made; give root.json to the robots and timestamp.pem to the collector")


@bundle.command()
def delegate(
    place: Place, repository: Repository = _HERE, keys: Keys = None, passphrase_file: Secret = None
) -> None:
    """Make a key and a role for the bundles of a robot group.

    Example: rosrv-fleet bundle delegate site-a/arms
    """
    with _open(repository, keys, passphrase_file) as opened:
        opened.delegate(*_split(place))
        say(f"{place}: delegated; its bundles are signed with a key of its own")


@bundle.command()
def add(
    place: Place,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="policy.ini, hosts.yaml, monitors/…")],
    *,
    ring: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=ROBOT,…|PERCENT%[+WAIT]", help="A ring, in order; the last one has 100%"),
    ] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="A note that is signed with the bundle")] = "",
    keep: Annotated[
        int, typer.Option(min=1, max=20, help="Signed bundles of the group; older ones are withdrawn")
    ] = KEPT,
    repository: Repository = _HERE,
    keys: Keys = None,
    passphrase_file: Secret = None,
) -> None:
    """Check a folder, and sign it as the next bundle of a robot group.

    Robots of a later ring do not take the bundle before its wait has passed since the signature. The collector may
    delay it further, but cannot give it to them earlier.

    Example: rosrv-fleet bundle add site-a/arms arms --ring canary=arm-1,arm-2 --ring rest=100%+4h
    """
    with _open(repository, keys, passphrase_file) as opened:
        files = _files_in(folder)
        findings = _findings_of(contents_of(files))
        if findings:
            raise BundleArchiveError("\n".join([*findings, f"{folder}: nothing was signed"]))
        rings = [_ring(text) for text in ring or ["all=100%"]]
        now = int(opened.now().timestamp())
        path = opened.add(*_split(place), files, Terms(now, rings, note), keep=keep)
        say(f"{path}: signed; publish it: rosrv-fleet bundle publish FOLDER")


@bundle.command()
def withdraw(
    name: Annotated[str, typer.Argument(metavar="BUNDLE", help="SITE/GROUP/VERSION.tar")],
    repository: Repository = _HERE,
    keys: Keys = None,
    passphrase_file: Secret = None,
) -> None:
    """Withdraw a bundle: sign the group's other bundles, so that robots never take this one again.

    Example: rosrv-fleet bundle withdraw site-a/arms/12.tar
    """
    with _open(repository, keys, passphrase_file) as opened:
        opened.withdraw(BundlePath.parse(name))
        say(f"{name}: withdrawn; publish it: rosrv-fleet bundle publish FOLDER")


@bundle.command()
def sign(
    root: Annotated[bool, typer.Option("--root", metavar="", help="Also sign the root again")] = False,
    repository: Repository = _HERE,
    keys: Keys = None,
    passphrase_file: Secret = None,
) -> None:
    """Sign all metadata again before they expire; robots take no bundle from expired metadata.

    Example: rosrv-fleet bundle sign && rosrv-fleet bundle publish /srv/bundles
    """
    with _open(repository, keys, passphrase_file) as opened:
        if root:
            opened.renew_root()
        opened.sign()
        _say_expiries(opened)


@bundle.command()
def rotate(
    role: Annotated[
        str, typer.Argument(metavar="ROLE", help="root, targets, snapshot, timestamp or SITE.GROUP")
    ],
    repository: Repository = _HERE,
    keys: Keys = None,
    passphrase_file: Secret = None,
) -> None:
    """Replace the key of a role. Robots accept the new key automatically, and reject the old one.

    Example: rosrv-fleet bundle rotate site-a.arms
    """
    with _open(repository, keys, passphrase_file) as opened:
        opened.rotate(role)
        more = "; give the new timestamp.pem to the collector" if role == "timestamp" else ""
        say(f"{role}: has a new key{more}; publish it: rosrv-fleet bundle publish FOLDER")


@bundle.command("list")
def list_bundles(repository: Repository = _HERE) -> None:
    """List the signed bundles with their rings, and when the metadata expire.

    Example: rosrv-fleet bundle list
    """
    with _open(repository, None, None) as opened:
        for path, target in opened.bundles():
            rings = ", ".join(f"{ring.name} after {ring.after} s" for ring in terms_of(target.custom).rings)
            say(f"{path}  {target.length} bytes  {rings}")
        _say_expiries(opened)


@bundle.command()
def publish(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The collector's folder of bundles")],
    repository: Repository = _HERE,
) -> None:
    """Copy the signed files to the collector's folder; the snapshot comes last, so that no robot gets half of them.

    To another machine, copy `metadata` and `targets` to a separate folder with any tool, and run the command there. An
    interrupted copy is not published.

    Example: rosrv-fleet bundle publish /srv/bundles
    """
    with _open(repository, None, None):
        state = read_publication(repository)
        _copy(repository / "targets", folder / "targets", "**/*.tar")
        _copy(repository / "metadata", folder / "metadata", "*.json", leave="snapshot")
        _copy(repository / "metadata", folder / "metadata", "*.snapshot.json")
        read_publication(folder)
        say(f"{folder}: snapshot {state.snapshot} with {counted(len(state.bundles), 'bundle')} is published")


@contextmanager
def _open(repository: Path, keys: Path | None, passphrase_file: Path | None) -> Iterator[BundleRepository]:
    def passphrase(key: Path) -> str:
        if passphrase_file is not None:
            return read_given(passphrase_file, 4096).decode().partition("\n")[0]
        return str(
            typer.prompt(f"Passphrase of {key.name}", hide_input=True, confirmation_prompt=not key.exists())
        )

    folder = KeyFolder(repository / "keys" if keys is None else keys, passphrase)
    try:
        yield BundleRepository(repository, folder)
    except (
        BundleArchiveError,
        KeyFileError,
        PublicationError,
        RepositoryError,
        TermsError,
        OSError,
    ) as error:
        typer.echo(f"rosrv-fleet bundle: {error}", err=True)
        raise typer.Exit(1) from error


def _findings_of(contents: BundleContents) -> list[str]:
    try:
        # The collector's machine has no compiler of policies and specifications, and signs no bundles.
        from rosrv_fleet.bundles.checks import findings_of  # noqa: PLC0415  only where bundles are signed
    except ImportError as error:
        raise BundleArchiveError(
            f"bundles are checked with the appliance's own code, and {error.name} is not installed:"
            " install rosrv-appliance of the same version on this machine"
        ) from error
    return findings_of(contents)


def _split(place: str) -> tuple[str, str]:
    site, slash, group = place.partition("/")
    if not slash:
        raise TermsError(f"{place[:80]!r} is not SITE/GROUP, for example site-a/arms")
    return site, group


def _ring(text: str) -> Ring:
    """Parse `NAME=ROBOT,…`, or `NAME=PERCENT%`, with a wait such as `+1h`. Raises `TermsError`."""
    match = _RING.fullmatch(text)
    if match is None:
        raise TermsError(f"{text[:80]!r} is not a ring, for example canary=arm-1,arm-2 or rest=100%+4h")
    name, percent, robots, count, unit = match.groups()
    after = int(count or 0) * _UNITS[unit or "s"]
    return Ring(name, robots.split(",") if robots else [], int(percent or 0), after)


def _files_in(folder: Path) -> dict[str, bytes]:
    files = {}
    for path in files_below(folder):
        name = str(path.relative_to(folder))
        if not is_bundle_file(name):
            raise BundleArchiveError(f"{path} does not belong in a bundle: remove it")
        files[name] = read_given(path, LONGEST)
    return files


def _copy(source: Path, target: Path, pattern: str, leave: str = "") -> None:
    for path in sorted(source.glob(pattern)):
        copied = target / path.relative_to(source)
        content = path.read_bytes()
        if (leave and f".{leave}." in path.name) or (copied.exists() and copied.read_bytes() == content):
            continue
        copied.parent.mkdir(parents=True, exist_ok=True)
        write_whole(copied, content, 0o644)


def _say_expiries(repository: BundleRepository) -> None:
    for role, expires in sorted(repository.expiries().items(), key=lambda one: one[1]):
        say(f"{role}: expires {expires:%Y-%m-%d}")
