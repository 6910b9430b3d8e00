"""Pack and unpack bundles: a policy with its test cases, specifications and `hosts.yaml` in one archive. No I/O.

An archive is an uncompressed tar file (ustar) with these files, sorted by name:

policy.ini                          the access policy
policy.ini.tests.yaml               optional: the policy's test cases
hosts.yaml                          the hosts to enrol
monitors/NAME.rv                    specifications
monitors/msg/PACKAGE/NAME.msg|.srv  message definitions
FILE.sig                            optional: the site's signature of a file, except hosts.yaml and the test cases

An archive is accepted only if packing its contents gives the same bytes, so links, devices, trailing data and
unusual headers are rejected.
"""

import io
import re
import tarfile
from collections.abc import Mapping
from typing import Annotated

import msgspec

LONGEST = 6 << 20
"""The most bytes of an archive."""

_MAX_FILES = 2500
_LONGEST_HOSTS = 1 << 20
POLICY, CASES, HOSTS = "policy.ini", "policy.ini.tests.yaml", "hosts.yaml"
_WORD = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"
_SPECIFICATION = re.compile(rf"monitors/({_WORD}\.rv)")
_DEFINITION = re.compile(rf"monitors/msg/({_WORD}/{_WORD}\.(?:msg|srv))")
_SIGNATURE = ".sig"

_END = r"$(?!\n)"  # Python's `$` also matches before a final newline
_SpecificationName = Annotated[str, msgspec.Meta(pattern=rf"^{_WORD}\.rv{_END}")]
_DefinitionName = Annotated[str, msgspec.Meta(pattern=rf"^{_WORD}/{_WORD}\.(?:msg|srv){_END}")]


class BundleContents(msgspec.Struct, frozen=True):
    """The texts of a bundle; missing signatures are empty. Decoded contents have only names that an archive may have.

    `definitions` is keyed by `package/Type.msg` (or `.srv`), and `signatures` by the names of the signed files.
    """

    policy: str
    hosts: str
    policy_signature: str = ""
    cases: str | None = None
    files: dict[_SpecificationName, str] = {}
    definitions: dict[_DefinitionName, str] = {}
    signatures: dict[str, str] = {}


class BundleArchiveError(Exception):
    """An archive or its contents are invalid."""


def is_bundle_file(name: str) -> bool:
    whole = name.removesuffix(_SIGNATURE)
    if whole in (POLICY, CASES, HOSTS):
        return whole in (name, POLICY)
    return bool(_SPECIFICATION.fullmatch(whole) or _DEFINITION.fullmatch(whole))


def pack(files: Mapping[str, bytes]) -> bytes:
    """Return the archive. Raises `BundleArchiveError` if the files are not a valid bundle."""
    contents_of(files)
    return _pack(files)


def unpack(archive: bytes) -> BundleContents:
    """Return the contents of an archive. Raises `BundleArchiveError`."""
    if len(archive) > LONGEST:
        raise BundleArchiveError(f"the archive has {len(archive)} bytes; the limit is {LONGEST}")
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:", errorlevel=2) as tar:
            for member in tar:
                if not member.isreg() or not is_bundle_file(member.name) or member.name in files:
                    raise BundleArchiveError(f"{member.name[:200]!r} is not a file of a bundle")
                if len(files) >= _MAX_FILES:
                    raise BundleArchiveError(f"the archive has more than {_MAX_FILES} files")
                opened = tar.extractfile(member)
                files[member.name] = opened.read() if opened is not None else b""
    except (tarfile.TarError, OSError, ValueError, OverflowError) as error:
        raise BundleArchiveError(f"the archive is not a valid tar file: {error}") from error
    contents = contents_of(files)
    if _pack(files) != archive:
        raise BundleArchiveError("the archive was not made by rosrv-fleet bundle add: make it again")
    return contents


def contents_of(files: Mapping[str, bytes]) -> BundleContents:
    """Return the contents that the files have. Raises `BundleArchiveError`."""
    unknown = [name for name in files if not is_bundle_file(name)]
    if unknown:
        raise BundleArchiveError(f"{unknown[0][:200]!r} is not a file of a bundle: remove it")
    if len(files) > _MAX_FILES:
        raise BundleArchiveError(f"a bundle has at most {_MAX_FILES} files, not {len(files)}")
    for name in (POLICY, HOSTS):
        if name not in files:
            raise BundleArchiveError(f"{name} is missing: a bundle states the policy and the hosts")
    alone = [
        name for name in files if name.endswith(_SIGNATURE) and name.removesuffix(_SIGNATURE) not in files
    ]
    if alone:
        raise BundleArchiveError(f"{alone[0]} is the signature of a file that the bundle does not have")
    texts = {name: _text(name, data) for name, data in files.items()}
    if len(texts[HOSTS]) > _LONGEST_HOSTS:
        raise BundleArchiveError(f"{HOSTS} is longer than {_LONGEST_HOSTS} characters")
    named = {name: match[1] for name in texts if (match := _SPECIFICATION.fullmatch(name))}
    defined = {name: match[1] for name in texts if (match := _DEFINITION.fullmatch(name))}
    return BundleContents(
        policy=texts[POLICY],
        hosts=texts[HOSTS],
        policy_signature=texts.get(POLICY + _SIGNATURE, ""),
        cases=texts.get(CASES),
        files={short: texts[name] for name, short in named.items()},
        definitions={short: texts[name] for name, short in defined.items()},
        signatures={
            short: texts[name + _SIGNATURE]
            for name, short in (named | defined).items()
            if name + _SIGNATURE in texts
        },
    )


def _text(name: str, data: bytes) -> str:
    """Read UTF-8 as a local load does, with LF line ends, and without a BOM in specifications."""
    try:
        text = data.decode("utf-8-sig" if name.startswith("monitors/") else "utf-8")
    except UnicodeDecodeError as error:
        raise BundleArchiveError(f"{name} is not UTF-8 text: {error.reason}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _pack(files: Mapping[str, bytes]) -> bytes:
    output = io.BytesIO()
    with tarfile.open(fileobj=output, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name in sorted(files):
            member = tarfile.TarInfo(name)
            member.size = len(files[name])
            tar.addfile(member, io.BytesIO(files[name]))
    packed = output.getvalue()
    if len(packed) > LONGEST:
        raise BundleArchiveError(f"the archive has {len(packed)} bytes; the limit is {LONGEST}")
    return packed
