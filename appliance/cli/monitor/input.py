"""What the monitor verbs read: specifications, and folders of message definitions."""

import functools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.input_files import read_given, read_given_text
from appliance.cli import output
from appliance.specifications.specification_files import Sources, signatures_of
from rosmop.form.positions import Position
from rosmop.text.errors import SpecificationError
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions

usage_error = functools.partial(output.usage_error, verb="rosrv monitor")
Files = Annotated[
    list[Path], typer.Argument(metavar="FILE…", help="Specifications (.rv)", show_default=False)
]
Folders = Annotated[
    list[Path] | None,
    typer.Option("--msg", metavar="DIR", help="A folder of message definitions (repeatable)"),
]
Bags = Annotated[
    list[Path], typer.Option("--bag", metavar="FILE", help="A recording (repeatable)", show_default=False)
]
_NOT_UTF_8 = re.compile("[\udc80-\udcff]")
_SAVE_AS_UTF_8 = "these bytes are no UTF-8; save the file as UTF-8"
_STRING_CONSTANT = re.compile(r"\s*string\s+\w+\s*=")  # whose value goes to the end of the line
BESIDE = "msg"
"""The folder of definitions that is looked into beside every specification."""


def read_specifications(files: Sequence[Path]) -> dict[str, str]:
    """The texts of specifications by name, in the order of file names. Bytes that are no UTF-8 are half of a character
    (`surrogateescape`), which no specification may have: it is refused with all else that is wrong.
    """
    texts: dict[str, str] = {}
    for file in sorted(files, key=lambda path: (path.name, str(path))):
        try:
            raw = read_given(file)
        except OSError as error:
            raise usage_error(f"cannot read {file}: {error.strerror}") from error
        texts[str(file)] = raw.decode("utf-8-sig", "surrogateescape")
    return texts


def read_definitions(files: Sequence[Path], folders: Sequence[Path]) -> Definitions:
    """ROS's own definitions, those in `msg/` beside the specifications, and those of the folders.

    Later ones win. Raises `SpecificationError` for a definition that cannot be read.
    """
    definitions = standard_definitions()
    for folder in _folders_of(files, folders):
        texts, places = _definition_texts(folder)
        try:
            definitions = definitions.extended(Definitions.from_files(texts))
        except DefinitionError as error:
            place = places.get(error.source, str(folder / error.source))
            raise SpecificationError.at(Position(place, max(error.line, 1), 1), error.text) from None
    return definitions


def read_to_send(files: Sequence[Path], folders: Sequence[Path]) -> Sources:
    """Specifications by the names that the appliance knows them by, and the definitions for them, as files.

    The same files are taken and refused as by `read_specifications` and `read_definitions`; what the definitions say is
    judged where they are sent to. Raises `SpecificationError`.
    """
    named: dict[str, Path] = {}
    for file in files:
        other = named.setdefault(file.name, file)
        if os.path.realpath(other) != os.path.realpath(file):
            raise usage_error(
                f"{other} and {file} have one name, and the appliance knows specifications by the names of their "
                "files: load them under different names"
            )
    definitions: dict[str, str] = {}
    for folder in _folders_of(files, folders):
        texts, places = _definition_texts(folder)
        definitions |= {name: _sendable(text, places[name]) for name, text in texts.items()}
        named |= {name: Path(places[name]) for name in texts}
    texts = read_specifications(files)
    for path, text in texts.items():
        found = _NOT_UTF_8.search(text)
        if found is not None:
            line = text.count("\n", 0, found.start()) + 1
            column = found.start() - text.rfind("\n", 0, found.start())
            raise SpecificationError.at(Position(path, line, column), _SAVE_AS_UTF_8)
    sent = {Path(path).name: text for path, text in texts.items()}
    return Sources(sent, definitions, signatures_of(named))


def _folders_of(files: Sequence[Path], folders: Sequence[Path]) -> list[Path]:
    for folder in folders:
        if not folder.is_dir():
            raise usage_error(f"--msg: {folder} is no folder")
    beside = dict.fromkeys(file.parent / BESIDE for file in files)
    return [*(path for path in beside if path.is_dir()), *folders]


def _definition_texts(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """The definitions below a folder by `package/File`, and where each stands, by that name and the type's."""
    texts: dict[str, str] = {}
    places: dict[str, str] = {}
    for path in sorted(path for path in folder.rglob("*") if path.suffix in (".msg", ".srv")):
        if not path.is_file():
            continue
        package = path.parent.parent if path.parent.name in ("msg", "srv") else path.parent
        if package == folder.parent or path.parent == folder:
            text = f"a definition belongs into the folder of its package: {folder}/package/{path.name}"
            raise SpecificationError.at(Position(str(path), 1, 1), text)
        name = f"{package.name}/{path.name}"
        places[name] = places[name.rsplit(".", 1)[0]] = str(path)
        texts[name] = _text_of(path)
    return texts, places


def _text_of(path: Path) -> str:
    try:
        return read_given_text(path, errors="surrogateescape")
    except OSError as error:
        raise usage_error(f"cannot read {path}: {error.strerror}") from error


def _sendable(text: str, place: str) -> str:
    """The same in UTF-8. Old definitions have comments in other encodings, which mean nothing; all else would."""
    lines = text.split("\n")
    for number, line in enumerate(lines):
        if line.isascii() or not _NOT_UTF_8.search(line):
            continue
        said = line if _STRING_CONSTANT.match(line) else line.partition("#")[0]
        if _NOT_UTF_8.search(said):
            raise SpecificationError.at(Position(place, number + 1, 1), _SAVE_AS_UTF_8)
        lines[number] = _NOT_UTF_8.sub("\N{REPLACEMENT CHARACTER}", line)
    return "\n".join(lines)
