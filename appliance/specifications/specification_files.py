"""Read files of specifications: the folder, their signatures, and their compiled contents."""

import stat
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import msgspec

from appliance.base.input_files import entries_of, files_below, read_given_text, stat_given
from appliance.channel import messages
from appliance.signing.site_keys import UnsignedError, read_signature, signer
from rosmop.form.switch_words import without_file_switch
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_view import read_fields

_MAX_FILES = 1000
_LONGEST_FILE = 1 << 20
_LONGEST = (
    3 << 20
)  # characters of all files and definitions: the compiler has a minute, and takes 14 s for each MiB


class MonitorsChangedError(Exception):
    """The monitors changed after a change was prepared; `tag` is the present one."""

    def __init__(self, expected: str, tag: str) -> None:
        super().__init__(
            f"the monitors were loaded, switched or resumed in the meantime (they are at {tag}, not at {expected}):"
            " list them first"
        )
        self.tag = tag


class SpecificationsRefusedError(Exception):
    """Specifications are refused; `findings` has every reason, as `file:line:column: error: text`."""

    def __init__(self, findings: list[str]) -> None:
        super().__init__("\n".join(findings))
        self.findings = findings


class Sources(msgspec.Struct, frozen=True):
    """Specifications by file name, and definitions by `package/Type.msg` (or `.srv`)."""

    files: dict[str, str] = {}
    definitions: dict[str, str] = {}
    signatures: dict[str, str] = {}
    topics: dict[str, dict[str, str]] = {}

    def with_topics(
        self, topics: Mapping[str, Mapping[str, str]], among: Collection[str] | None = None
    ) -> "Sources":
        kept = {name: dict(given) for name, given in topics.items() if among is None or name in among}
        return msgspec.structs.replace(self, topics=kept)

    def with_files(self, new: "Sources") -> "Sources":
        fresh = new.files.keys() | new.definitions.keys()
        signatures = {name: text for name, text in self.signatures.items() if name not in fresh}
        signatures |= {name: text for name, text in new.signatures.items() if text and name in fresh}
        return Sources(
            dict(sorted((self.files | new.files).items())),
            dict(sorted((self.definitions | new.definitions).items())),
            signatures,
            self.topics
            | {name: {**self.topics.get(name, {}), **given} for name, given in new.topics.items()},
        )

    def without(self, files: set[str]) -> "Sources":
        """Return the sources without these files; the message definitions stay."""
        left, signatures = (
            {name: text for name, text in texts.items() if name not in files}
            for texts in (self.files, self.signatures)
        )
        return Sources(left, self.definitions, signatures, self.topics)

    def signers(self, site_keys: Sequence[str]) -> list[str]:
        """Return the names of the keys that signed. Raises `SpecificationsRefusedError` with all unsigned files."""
        found, unsigned = self._signed(site_keys)
        if unsigned:
            raise SpecificationsRefusedError([*unsigned.values()])
        return sorted(found)

    def signed_only(self, site_keys: Sequence[str]) -> tuple["Sources", dict[str, str]]:
        _, errors = self._signed(site_keys)
        files, definitions = (
            {name: text for name, text in texts.items() if folder + name not in errors}
            for folder, texts in (("", self.files), ("msg/", self.definitions))
        )
        return Sources(files, definitions, self.signatures), errors

    def _signed(self, site_keys: Sequence[str]) -> tuple[set[str], dict[str, str]]:
        found: set[str] = set()
        unsigned = {}
        # One name may be in both, with one signature: it must fit both texts.
        texts = [("", *item) for item in self.files.items()]
        texts += [("msg/", *item) for item in self.definitions.items()]
        for folder, name, text in texts if site_keys else ():
            try:
                found.add(signer(site_keys, text, self.signatures.get(name, "")))
            except UnsignedError as error:
                unsigned[folder + name] = f"{folder}{name}:1:1: error: {error}"
        return found, unsigned

    def difference(self, before: "Sources") -> tuple[list[str], list[str], list[str]]:
        """Return the added, changed and removed names; a definition is `msg/package/Type.msg`."""
        old, new = before.by_name(), self.by_name()
        return (
            [name for name in new if name not in old],
            [name for name in new if name in old and old[name] != new[name]],
            [name for name in old if name not in new],
        )

    def without_switches(self) -> "Sources":
        """Return the sources without the words of their `preset` statements, which change with each switch."""
        files = {name: without_file_switch(text) for name, text in self.files.items()}
        return msgspec.structs.replace(self, files=files)

    def by_name(self) -> dict[str, str]:
        return self.files | {f"msg/{name}": text for name, text in self.definitions.items()}


class CheckedSpecifications(messages.Contents, frozen=True):
    """Specifications that may come into force; `signed_by` are keys of the site."""

    signed_by: list[str] = []  # noqa: RUF012  each struct gets one of its own

    def fields(self, topic: str, data: bytes) -> dict[str, object] | None:
        name = self.types.get(topic)
        definitions = _definitions(name, self.texts.get(name, "")) if name is not None else None
        return read_fields(definitions, name, data) if name is not None and definitions is not None else None

    def md5sum(self, topic: str) -> str:
        name = self.types.get(topic, "")
        definitions = _definitions(name, self.texts.get(name, ""))
        return "" if definitions is None else definitions.md5sum(name)

    def of_topic(self, topic: str) -> bool:
        return any(topic in topics for topics in self.topics.values())

    def of_service(self, service: str) -> bool:
        return any(service in services for services in self.services.values())


@lru_cache(maxsize=1000)
def _definitions(name: str, text: str) -> Definitions | None:
    try:
        return Definitions.from_full_text(name, text)
    except DefinitionError:
        return None


def checked(contents: messages.Contents, sources: Sources, site_keys: Sequence[str]) -> CheckedSpecifications:
    """Return the contents with their signers. Raises `SpecificationsRefusedError`."""
    return CheckedSpecifications(**msgspec.structs.asdict(contents), signed_by=sources.signers(site_keys))


def require_bounded(sources: Sources) -> None:
    """Raise `SpecificationsRefusedError` if the specifications exceed a limit."""
    if len(sources.files) > _MAX_FILES:
        raise SpecificationsRefusedError(
            [
                f"{len(sources.files)} specification files; the limit is {_MAX_FILES}: put several specifications"
                " into one file"
            ]
        )
    if sum(map(len, [*sources.files.values(), *sources.definitions.values()])) > _LONGEST:
        raise SpecificationsRefusedError(
            [f"specifications and definitions are longer than {_LONGEST} characters: load fewer"]
        )
    for name, text in sources.files.items():
        if len(text) > _LONGEST_FILE:
            raise SpecificationsRefusedError([_too_long(name)])


def _too_long(name: str) -> str:
    return f"{name}: longer than {_LONGEST_FILE} characters"


def read_folder(folder: Path) -> Sources:
    """Read specifications, definitions and signatures. Raises `SpecificationsRefusedError`."""
    sources, errors = _read_folder(folder)
    if errors:
        raise SpecificationsRefusedError([*errors.values()])
    return sources


def read_usable(folder: Path, site_keys: Sequence[str]) -> tuple[Sources, dict[str, str]]:
    """Return the sources, and the errors of files that may not come into force.

    Raises `SpecificationsRefusedError`.
    """
    found, errors = _read_folder(folder)
    sources, unsigned = found.signed_only(site_keys)
    longer = {name: _too_long(name) for name, text in sources.files.items() if len(text) > _LONGEST_FILE}
    return sources.without({*longer}), errors | unsigned | longer


def _read_folder(folder: Path) -> tuple[Sources, dict[str, str]]:
    try:
        if not _is(stat.S_ISDIR, folder):
            raise SpecificationsRefusedError(
                [
                    f"{folder}: the folder of specifications does not exist; create it, or name another with --monitors"
                ]
            )
        paths = {path.name: path for path, _is_folder in entries_of(folder) if path.match("*.rv")}
    except OSError as error:
        raise _unreadable(folder, error) from error
    definitions: dict[str, Path] = {}
    texts: dict[str, str] = {}
    errors: dict[str, str] = {}
    try:
        definitions = _definitions_in(folder / "msg")
    except SpecificationsRefusedError as error:
        errors["msg"] = str(error)
    for name, path in (paths | {f"msg/{name}": path for name, path in definitions.items()}).items():
        try:
            texts[name] = _read(path)
        except SpecificationsRefusedError as error:
            errors[name] = str(error)
    return Sources(
        {name: texts[name] for name in paths if name in texts},
        {name: texts[f"msg/{name}"] for name in definitions if f"msg/{name}" in texts},
        signatures_of(paths | definitions),
    ), errors


def _definitions_in(own: Path) -> dict[str, Path]:
    found = {}
    try:
        for path in files_below(own) if _is(stat.S_ISDIR, own) else ():
            if path.suffix in {".msg", ".srv"} and _is(stat.S_ISREG, path):
                package = path.parent.parent if path.parent.name in {"msg", "srv"} else path.parent
                if package in {own.parent, own}:
                    text = f"a definition belongs in the folder of its package: {own}/package/{path.name}"
                    raise SpecificationsRefusedError([f"{path}: {text}"])
                found[f"{package.name}/{path.name}"] = path
    except OSError as error:
        raise _unreadable(own, error) from error
    return found


def _unreadable(path: Path, error: OSError) -> SpecificationsRefusedError:
    text = f"{error.filename or path}: the specifications cannot be read: {error.strerror}"
    return SpecificationsRefusedError([text])


def _is(kind: Callable[[int], bool], path: Path) -> bool:
    """Return whether the path is of this kind. Raises `OSError` if it is unknown whether it exists."""
    try:
        return kind(stat_given(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def signatures_of(paths: Mapping[str, Path]) -> dict[str, str]:
    found = {name: read_signature(path) for name, path in paths.items()}
    return {name: text for name, text in found.items() if text}


def _read(path: Path) -> str:
    try:
        return read_given_text(path, "utf-8-sig")
    except OSError as error:
        raise _unreadable(path, error) from error
    except UnicodeDecodeError as error:
        raise SpecificationsRefusedError([f"{path}: is not UTF-8 text: {error.reason}"]) from error


_Stamp = tuple[str, int, int, int, int]


class SpecificationFolder:
    """The folder of specifications, or an empty one; files are read only if one has changed."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._stamps: list[_Stamp] | None = None
        self._found: Sources | None = None

    def read(self) -> Sources:
        return read_folder(self.path) if self.path is not None else Sources()

    def read_usable(self, site_keys: Sequence[str]) -> tuple[Sources, dict[str, str]]:
        return read_usable(self.path, site_keys) if self.path is not None else (Sources(), {})

    def looked_at(self) -> Sources | None:
        if self.path is None:
            return Sources()
        stamps = _stamps(self.path)
        if stamps is None or stamps != self._stamps:
            try:
                self._found = self.read()
            except SpecificationsRefusedError:
                self._found = None
            self._stamps = stamps
        return self._found


def _stamps(folder: Path) -> list[_Stamp] | None:
    try:
        own = folder / "msg"
        found = [path for path, _is_folder in entries_of(folder) if path.match("*.rv*")]
        found += files_below(own) if _is(stat.S_ISDIR, own) else []
        return sorted(_stamp(path) for path in [folder, *found])
    except OSError:
        return None


def _stamp(path: Path) -> _Stamp:
    about = stat_given(path)
    return str(path), about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns
