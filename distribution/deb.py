"""`make package`: build dist/rosrv_VERSION_ARCH.deb for Debian 12 and 13.

    python -m distribution.deb amd64 arm64

All files have the time of the newest commit, so two builds of one commit are equal byte by byte. DEBFULLNAME and
DEBEMAIL name the maintainer, as for Debian's own tools.
"""

import os
import re
import shutil
import subprocess
import sys
from email.utils import formatdate
from pathlib import Path

from appliance import __version__
from appliance.configuration.inventory import RUNS
from appliance.supervisor.users import NUMERIC_IDS
from distribution import extension
from distribution.checkout import ROOT, BuildError, facts, revision, run, time_of_commit
from distribution.environment import ARCHITECTURES, INTERPRETERS, Architecture, make_environment
from distribution.extension import IN_PLACE, ExtensionError
from distribution.man import write_pages

HERE = ROOT / "distribution"
VERSION = __version__.replace(".dev", "~dev")  # dpkg sorts 0.3.0~dev0 before 0.3.0
LIBRARY = "usr/lib/rosrv"
_TOOLS = {"dh_installsystemd": "debhelper", "dpkg-buildpackage": "dpkg-dev", "lintian": "lintian"}
COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/rosrv",
    "zsh": "usr/share/zsh/vendor-completions/_rosrv",
    "fish": "usr/share/fish/vendor_completions.d/rosrv.fish",
}
"""The files in which each shell looks for the completions of a package."""
_NO_ADDRESS = "maintainers@localhost"
_LAUNCHER = """\
#!/usr/lib/rosrv/bin/python -P
import os

from appliance.cli.main import main

# In any other folder the appliance of this machine is meant.
if not os.path.exists("appliance.yaml"):
    os.environ.setdefault("ROSRV_CONFIG", "/etc/rosrv/appliance.yaml")
main()
"""


def build(architecture: Architecture, *, moment: int) -> Path:
    """Build the package, or raise `BuildError` or `ExtensionError`.

    All its files get the time `moment` (seconds since the epoch).
    """
    work = ROOT / "build/package" / architecture.debian
    shutil.rmtree(work, ignore_errors=True)
    source = work / "source"
    source.mkdir(parents=True)
    _gather(source, architecture, work, moment)
    _debian_folder(source / "debian", moment)
    for path in source.rglob("*"):  # dpkg lowers later times, but keeps earlier times
        os.utime(path, (moment, moment), follow_symlinks=False)
    environment = {"SOURCE_DATE_EPOCH": str(moment), "DEB_BUILD_OPTIONS": "nocheck", "LC_ALL": "C.UTF-8"}
    log = work / "build.log"
    with log.open("wb") as output:
        run(
            # Nothing is compiled, so nothing of the other architecture is needed (-d).
            ["dpkg-buildpackage", "--build=binary", "-us", "-uc", "-d", f"--host-arch={architecture.debian}"],
            missing=f"sudo apt-get install {_TOOLS['dpkg-buildpackage']}",
            failed=f"the reason is in {log.relative_to(ROOT)}",
            cwd=source,
            env=os.environ | environment,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    made = work / f"rosrv_{VERSION}_{architecture.debian}.deb"
    dist = ROOT / "dist" / made.name
    dist.parent.mkdir(exist_ok=True)
    shutil.move(made, dist)
    return dist


def _gather(source: Path, architecture: Architecture, work: Path, moment: int) -> None:
    root = source / "root"
    library = root / LIBRARY
    make_environment(library, architecture, work)
    _make_virtual(library)
    for package in ("appliance", "roswire", "rosmop"):
        _copy(
            ROOT / package, library / "common" / package,
            "tests", "docs", "README.md", "Makefile", "*.toml", IN_PLACE.name,
        )  # fmt: skip
    shutil.copyfile(extension.build(architecture.triplet), library / "common" / IN_PLACE.relative_to(ROOT))
    shipped = root / "usr/share/rosrv"
    for folder in ("examples", "monitors", "policies"):
        _copy(ROOT / folder, shipped / folder)
    (shipped / "build.json").write_text(facts("package", architecture.debian, revision(), moment))
    (shipped / "scripts").mkdir()
    shutil.copy(ROOT / "scripts/build-roscpp", shipped / "scripts")
    # The program finds its data here, as with the wheel.
    (library / "share").symlink_to("../../share")
    (root / "usr/bin").mkdir(parents=True)
    launcher = root / "usr/bin/rosrv"
    launcher.write_text(_LAUNCHER)
    launcher.chmod(0o755)
    settings = root / "etc/rosrv"
    settings.mkdir(parents=True)
    shutil.copyfile(HERE / "appliance.yaml", settings / "appliance.yaml")
    # The monitors and policies of the LandShark and of compose.yaml are examples, in usr/share/rosrv.
    (settings / "monitors").mkdir()
    (settings / "policies").mkdir()
    for name in ("default.ini", "default.ini.tests.yaml"):
        shutil.copy(ROOT / "policies" / name, settings / "policies")
    _copy(ROOT / "ipsec", settings / "ipsec")
    dropin = root / "usr/lib/systemd/system/strongswan.service.d"
    dropin.mkdir(parents=True)
    shutil.copyfile(HERE / "strongswan.service.conf", dropin / "rosrv.conf")
    shutil.copyfile(HERE / "debian/rosrv-hold.service", dropin.parent / "rosrv-hold.service")
    at_python_update = root / "usr/share/python3/runtime.d/rosrv.rtupdate"
    at_python_update.parent.mkdir(parents=True)
    shutil.copyfile(HERE / "debian/rosrv.rtupdate", at_python_update)
    at_python_update.chmod(0o755)
    date = formatdate(moment)
    write_pages(root / "usr/share/man/man1", " ".join(date.split()[1:4]))
    _documentation(root / "usr/share/doc/rosrv")
    for shell, place in COMPLETIONS.items():
        shown = run(
            [str(ROOT / ".venv/bin/rosrv")],
            missing="scripts/setup",
            env=os.environ | {"_ROSRV_COMPLETE": f"source_{shell}"},
            stdout=subprocess.PIPE,
        )
        (root / place).parent.mkdir(parents=True)
        (root / place).write_text(shown)


def _make_virtual(library: Path) -> None:
    """Make `library` a virtual environment of Debian's interpreter, which may be any of `INTERPRETERS`."""
    (library / "bin").mkdir()
    (library / "bin/python").symlink_to("/usr/bin/python3")
    (library / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\n")


def _documentation(target: Path) -> None:
    _copy(ROOT / "docs", target)
    for name in ("README.md", "SECURITY.md"):
        shutil.copyfile(ROOT / name, target / name)
    (target / "examples").mkdir()
    for name in ("monitors", "policies"):
        (target / "examples" / name).symlink_to(f"../../../rosrv/{name}")


def _copy(folder: Path, target: Path, *without: str) -> None:
    shutil.copytree(folder, target, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", *without))


def _debian_folder(target: Path, moment: int) -> None:
    shutil.copytree(HERE / "debian", target)
    control = (target / "control").read_text()
    maintainer = f"{os.environ.get('DEBFULLNAME', 'The ROSRV maintainers')} <{os.environ.get('DEBEMAIL', _NO_ADDRESS)}>"
    control = control.replace("@RUNS@", ", ".join(RUNS)).replace("@MAINTAINER@", maintainer)
    (target / "control").write_text(control)
    (target / "changelog").write_text(
        f"rosrv ({VERSION}) stable; urgency=medium\n\n  * See CHANGELOG.md.\n\n"
        f" -- {maintainer}  {formatdate(moment)}\n"
    )
    lines = [f'u {name} - "ROSRV appliance" - -' for name in NUMERIC_IDS]
    # root reads the audit log as a member of its group if it has no CAP_DAC_OVERRIDE.
    (target / "rosrv.sysusers").write_text("\n".join([*lines, "m root rosrv-api"]) + "\n")
    (target / "rosrv.install").write_text("root/* /\n")
    for name in ("postinst", "prerm"):
        text = (target / f"rosrv.{name}").read_text()
        (target / f"rosrv.{name}").write_text(text.replace("@VERSIONS@", " ".join(INTERPRETERS)))


def _missing_packages(architectures: list[str]) -> list[str]:
    packages = [package for tool, package in _TOOLS.items() if shutil.which(tool) is None]
    foreign = ARCHITECTURES["arm64"].triplet
    if "arm64" in architectures and shutil.which(f"{foreign}-gcc") is None:
        packages += [f"gcc-{foreign.replace('_', '-')}", "libc6-dev-arm64-cross"]
    return packages


def main(arguments: list[str]) -> int:
    unknown = [name for name in arguments if name not in ARCHITECTURES]
    if unknown or not arguments:
        sys.stderr.write(f"package: give architectures of {', '.join(ARCHITECTURES)}, not {unknown}\n")
        return 2
    if missing := _missing_packages(arguments):
        sys.stderr.write(f"package: tools are missing: sudo apt-get install {' '.join(missing)}\n")
        return 1
    if re.fullmatch(r"\d+\.\d+\.\d+(~\w+)?", VERSION) is None:
        sys.stderr.write(f"package: {VERSION} is not a package version\n")
        return 1
    if "DEBEMAIL" not in os.environ:
        sys.stderr.write(f"package: DEBEMAIL is not set: the maintainer's address is {_NO_ADDRESS}\n")
    try:
        moment = time_of_commit()
        for name in arguments:
            sys.stderr.write(
                f"package: building for {name}; dpkg's output is in build/package/{name}/build.log\n"
            )
            made = build(ARCHITECTURES[name], moment=moment)
            sys.stdout.write(f"{made.relative_to(ROOT)}  {made.stat().st_size >> 20} MB\n")
    except (BuildError, ExtensionError, OSError) as error:
        sys.stderr.write(f"package: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
