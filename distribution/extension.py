"""Build the relay's compiled module, `appliance.relay.transport.pump`.

    python distribution/extension.py               # appliance/relay/transport/pump.abi3.so, for this machine
    python distribution/extension.py --sanitized   # build/extension/sanitized/pump.abi3.so, for the fuzzers

Every build uses this file. It needs gcc, the headers of libc and Python, and the locked Cython. It does nothing if
they and the source are unchanged. The module uses only the stable interface of Python 3.11, so it also runs with
later versions.
"""

import fcntl
import filecmp
import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path("appliance/relay/transport/pump.pyx")
IN_PLACE = ROOT / SOURCE.with_suffix(".abi3.so")
SANITIZED = "sanitized"
OLDEST = (3, 11)
_MODULE = ".".join(SOURCE.with_suffix("").parts)
_HEADERS = Path(sysconfig.get_path("include"))
_NATIVE: str = sysconfig.get_config_var("MULTIARCH")
_PACKAGES = "gcc libc6-dev python3-dev"
_WARNINGS = ("-Wall", "-Wextra", "-Wno-unused-parameter", "-Wno-missing-field-initializers")
_ALWAYS = (
    "-shared", "-fPIC", "-fno-strict-aliasing", "-fwrapv", f"-DPy_LIMITED_API=0x{OLDEST[0]:02x}{OLDEST[1]:02x}0000",
    f"-I{_HEADERS}", f"-ffile-prefix-map={ROOT}=.", "-Wl,-z,relro,-z,now,-z,noexecstack,--build-id=none",
)  # fmt: skip
_RELEASED = (
    "-O2", "-g0", "-s", "-DNDEBUG", "-fstack-protector-strong", "-fstack-clash-protection", "-D_FORTIFY_SOURCE=2",
)  # fmt: skip
_CHECKED = (
    "-O1",
    "-g",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
)


class ExtensionError(Exception):
    """The module cannot be built. The text has the reason and the remedy."""


def build(variant: str = _NATIVE) -> Path:
    """Return the module, compiled if it is not up to date. `variant` is a triplet or `SANITIZED`.

    Raise `ExtensionError`. A lock makes simultaneous calls safe.
    """
    folder = ROOT / "build/extension" / variant
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        made, stamp = folder / IN_PLACE.name, folder / "inputs"
        inputs = _inputs()
        if not (made.exists() and stamp.exists() and stamp.read_text() == inputs):
            stamp.unlink(missing_ok=True)
            _compile(variant, folder, made)
            stamp.write_text(inputs)
    return made


def install() -> bool:
    """Copy the module beside its source, and return whether it has changed."""
    made = build()
    if IN_PLACE.exists() and filecmp.cmp(made, IN_PLACE, shallow=False):
        return False
    copy = IN_PLACE.with_suffix(f".{os.getpid()}")
    try:
        shutil.copyfile(made, copy)
        copy.chmod(0o644)  # the appliance's processes run as other users
        copy.replace(IN_PLACE)
    finally:
        copy.unlink(missing_ok=True)
    return True


def _inputs() -> str:
    """Return a fingerprint of everything that the compiled file depends on, except gcc."""
    try:
        cython = version("cython")
    except PackageNotFoundError:
        raise ExtensionError(f"{sys.executable} has no Cython: run scripts/setup") from None
    parts = [(ROOT / SOURCE).read_bytes(), Path(__file__).read_bytes(), f"{cython} {sys.version}".encode()]
    return "\n".join(hashlib.sha256(part).hexdigest() for part in parts) + "\n"


def _compile(variant: str, folder: Path, made: Path) -> None:
    triplet, options = (_NATIVE, _CHECKED) if variant == SANITIZED else (variant, _RELEASED)
    compiler = "gcc" if triplet == _NATIVE else f"{triplet}-gcc"
    if shutil.which(compiler) is None or not (_HEADERS / "Python.h").exists():
        packages = _PACKAGES if triplet == _NATIVE else f"gcc-{triplet.replace('_', '-')} {_PACKAGES}"
        raise ExtensionError(f"{compiler} or {_HEADERS}/Python.h is missing: sudo apt-get install {packages}")
    headers = () if triplet == _NATIVE else (_foreign_headers(folder, triplet),)
    generated, making = folder / "pump.c", folder / "making"
    python = [
        sys.executable,
        "-m",
        "cython",
        "-X",
        "show_performance_hints=False",
        "--module-name",
        _MODULE,
        "-o",
        str(generated),
    ]
    _run([*python, str(SOURCE)])
    written = str(generated.relative_to(ROOT))
    _run([compiler, *_WARNINGS, *_ALWAYS, *options, *headers, "-o", str(making), written])
    making.replace(made)


def _foreign_headers(folder: Path, triplet: str) -> str:
    """Return the option that lets a compiler for another architecture find this machine's `pyconfig.h`.

    Debian installs only this header of Python by architecture. The files differ in four lines, which the stable
    interface does not use.
    """
    place = folder / "include" / triplet
    place.mkdir(parents=True, exist_ok=True)
    link = place / _HEADERS.name
    link.unlink(missing_ok=True)
    link.symlink_to(_HEADERS.parent / _NATIVE / _HEADERS.name)
    return f"-I{folder / 'include'}"


def _run(command: list[str]) -> None:
    done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=sys.stderr, check=False)
    if done.returncode:
        raise ExtensionError(
            f"{SOURCE}: this command ended with status {done.returncode}: {' '.join(command)}"
        )


def main(arguments: list[str]) -> int:
    if arguments not in ([], [f"--{SANITIZED}"]):
        sys.stderr.write(f"extension: the only option is --{SANITIZED}, not {' '.join(arguments)}\n")
        return 2
    try:
        if arguments:
            sys.stdout.write(f"{build(SANITIZED).relative_to(ROOT)}\n")
        elif install():
            sys.stderr.write(f"extension: built {IN_PLACE.relative_to(ROOT)}\n")
    except ExtensionError as error:
        sys.stderr.write(f"extension: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
