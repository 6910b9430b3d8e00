"""Read specifications and folders of message definitions."""

from collections.abc import Sequence
from pathlib import Path

from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.form.positions import Position
from rosmop.text.errors import SpecificationError
from rosmop.tool.program import Program
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions

BESIDE = "msg"
"""The folder of definitions that is looked into beside every specification."""


def load(
    program: Program, files: list[Path], folders: list[Path], recorded: Definitions | None = None
) -> Compiled:
    """Compile specifications. Raises `SpecificationError`.

    Definitions that were recorded apply to the types that no file defines.
    """
    definitions = read_definitions(program, files, folders)
    if recorded is not None:
        definitions = recorded.extended(definitions)
    return compiled_from(read_specifications(program, files), definitions)


def read_specifications(program: Program, files: Sequence[Path]) -> dict[str, str]:
    """The texts of specifications by name, in the order of file names. Bytes that are no UTF-8 are half of a character
    (`surrogateescape`), which no specification may have: it is refused with all else that is wrong.
    """
    texts: dict[str, str] = {}
    for file in sorted(files, key=lambda path: (path.name, str(path))):
        try:
            raw = program.read(file)
        except OSError as error:
            raise program.usage_error(f"cannot read {file}: {error.strerror}") from error
        texts[str(file)] = raw.decode("utf-8-sig", "surrogateescape")
    return texts


def read_definitions(program: Program, files: Sequence[Path], folders: Sequence[Path]) -> Definitions:
    """ROS's own definitions, those in `msg/` beside the specifications, and those of the folders.

    Later ones win. Raises `SpecificationError` for a definition that cannot be read.
    """
    definitions = standard_definitions()
    for folder in definition_folders(program, files, folders):
        texts, places = definition_texts(program, folder)
        try:
            definitions = definitions.extended(Definitions.from_files(texts))
        except DefinitionError as error:
            place = places.get(error.source, str(folder / error.source))
            raise SpecificationError.at(Position(place, max(error.line, 1), 1), error.text) from None
    return definitions


def definition_folders(program: Program, files: Sequence[Path], folders: Sequence[Path]) -> list[Path]:
    """Return the folders of definitions beside the files, and those that are given."""
    for folder in folders:
        if not folder.is_dir():
            raise program.usage_error(f"--msg: {folder} is no folder")
    beside = dict.fromkeys(file.parent / BESIDE for file in files)
    return [*(path for path in beside if path.is_dir()), *folders]


def definition_texts(program: Program, folder: Path) -> tuple[dict[str, str], dict[str, str]]:
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
        texts[name] = _text_of(program, path)
    return texts, places


def _text_of(program: Program, path: Path) -> str:
    try:
        return program.read_text(path)
    except OSError as error:
        raise program.usage_error(f"cannot read {path}: {error.strerror}") from error
