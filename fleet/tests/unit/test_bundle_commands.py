import shutil
from pathlib import Path

import pytest
from rosrv_fleet.bundles import repository as repository_module
from rosrv_fleet.bundles.commands import bundle
from rosrv_fleet.bundles.publication import PublicationError, read_publication
from typer.testing import CliRunner, Result

from appliance.base.atomic_files import write_whole
from fleet.tests.support.bundle_site import PASSPHRASE, POLICY
from tests.support.unreadable_folders import make_unreadable

pytestmark = pytest.mark.signing  # `bundle add` checks with the code of the appliance


class Desk:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.secret = folder / "passphrase"
        self.secret.write_text(f"{PASSPHRASE}\n")
        self.robot = folder / "arms"
        self.robot.mkdir()
        (self.robot / "policy.ini").write_text(POLICY)
        (self.robot / "hosts.yaml").write_text("hosts: []\n")

    def run(self, *words: str, secret: Path | None = None) -> Result:
        options = ["--repository", str(self.folder / "repository")]
        if words[0] not in ("list", "publish"):
            options += ["--passphrase-file", str(secret or self.secret)]
        return CliRunner().invoke(bundle, [*words, *options])

    def good(self, *words: str) -> str:
        done = self.run(*words)
        assert done.exit_code == 0, done.output
        return done.output


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    made = Desk(tmp_path)
    made.good("init")
    made.good("delegate", "site-a/arms")
    return made


def test_a_bundle_from_the_folder_to_the_collector(desk: Desk) -> None:
    served = desk.folder / "served"
    rings = ["--ring", "canary=arm-1", "--ring", "rest=100%+4h"]
    assert "site-a/arms/1.tar: signed" in desk.good("add", "site-a/arms", str(desk.robot), *rings)
    with pytest.raises(PublicationError):
        read_publication(served)
    desk.good("publish", str(served))
    assert [ring.after for ring in read_publication(served).bundles["site-a/arms/1.tar"].rings] == [0, 14_400]
    desk.good("add", "site-a/arms", str(desk.robot))
    desk.good("withdraw", "site-a/arms/1.tar")
    desk.good("rotate", "site-a.arms")
    desk.good("sign", "--root")
    desk.good("publish", str(served))
    assert list(read_publication(served).bundles) == ["site-a/arms/2.tar"]
    assert "site-a/arms/2.tar" in desk.good("list")
    assert not list(served.rglob("*.pem"))


def test_the_last_good_bundle_survives_a_bad_one_and_its_correction(desk: Desk) -> None:
    for _bundle in ("good", "bad", "correction"):
        desk.good("add", "site-a/arms", str(desk.robot))
    assert "site-a/arms/1.tar" in desk.good("list")
    desk.good("add", "site-a/arms", str(desk.robot))
    assert "site-a/arms/1.tar" not in desk.good("list")


def test_an_interrupted_copy_is_repeated_on_the_collectors_machine(desk: Desk) -> None:
    """The copy has no keys. A file that the interruption cut is copied again, and not published before."""
    served, incoming = desk.folder / "served", desk.folder / "incoming"
    publish = ["publish", str(served), "--repository", str(incoming)]
    desk.good("add", "site-a/arms", str(desk.robot))
    for folder in ("metadata", "targets"):
        shutil.copytree(desk.folder / "repository" / folder, incoming / folder)
    (cut,) = incoming.rglob("*.1.tar")
    whole = cut.read_bytes()
    cut.write_bytes(whole[:100])
    done = CliRunner().invoke(bundle, publish)
    assert (done.exit_code, "not a complete publication" in done.output) == (1, True)
    assert not served.exists()
    cut.write_bytes(whole)
    assert CliRunner().invoke(bundle, publish).exit_code == 0
    assert list(read_publication(served).bundles) == ["site-a/arms/1.tar"]


def test_publishing_again_repairs_a_damaged_file(desk: Desk) -> None:
    served = desk.folder / "served"
    desk.good("add", "site-a/arms", str(desk.robot))
    desk.good("publish", str(served))
    next(served.rglob("*.1.tar")).write_bytes(b"cut")
    with pytest.raises(PublicationError, match="publish it again"):
        read_publication(served)
    desk.good("publish", str(served))
    assert list(read_publication(served).bundles) == ["site-a/arms/1.tar"]


def test_a_folder_that_may_not_be_read_is_not_signed(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    (desk.robot / "monitors").mkdir()
    make_unreadable(desk.robot / "monitors", monkeypatch)
    done = desk.run("add", "site-a/arms", str(desk.robot))
    assert (done.exit_code, "Permission denied" in done.output, "signed;" in done.output) == (1, True, False)


def test_a_bundle_with_errors_is_not_signed(desk: Desk) -> None:
    (desk.robot / "policy.ini").write_text("[Nodes]\nnonsense\n")
    (desk.robot / "hosts.yaml").write_text("hosts: [{nam: x}]\n")
    (desk.robot / "monitors").mkdir()
    (desk.robot / "monitors" / "m.rv").write_text("m() {")
    done = desk.run("add", "site-a/arms", str(desk.robot))
    assert done.exit_code == 1
    for place in ("policy.ini:2", "hosts.yaml:1", "m.rv:1", "nothing was signed"):
        assert place in done.output
    assert "arms/1.tar" not in desk.good("list")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("init",), "has a repository"),
        (("delegate", "site-a/arms"), "delegated already"),
        (("delegate", "Site/arms"), "not a valid name"),
        (("delegate", "site-a"), "SITE/GROUP"),
        (("withdraw", "site-a/arms/7.tar"), "not signed"),
        (("rotate", "nothing"), "not a role"),
        (("add", "site-a/lifts", "arms"), "not delegated"),
        (("add", "site-a/arms", "arms", "--ring", "x=50%"), "100 percent"),
        (("add", "site-a/arms", "arms", "--ring", "x=y=z"), "not a ring"),
    ],
)
def test_mistakes_are_explained(desk: Desk, words: tuple[str, ...], reason: str) -> None:
    given = [str(desk.robot) if word == "arms" else word for word in words]
    done = desk.run(*given)
    assert done.exit_code == 1
    assert reason in done.output


def test_an_aborted_init_leaves_no_repository(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    short = tmp_path / "short"
    short.write_text("short\n")
    assert "at least 8 characters" in desk.run("init", secret=short).output
    assert "not a repository of bundles: rosrv-fleet bundle init" in desk.run("list").output
    desk.good("init")
    assert "has a repository" in desk.run("init").output
    desk.good("delegate", "site-a/arms")


@pytest.mark.parametrize("writes", range(6))
def test_a_killed_command_is_completed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    """`init` or `delegate` ends after some files; then the same command, or the next, leads to a whole repository."""

    def killed_after(files: int) -> None:
        left = iter(range(files))

        def write(path: Path, data: bytes, mode: int) -> None:
            if next(left, None) is None:
                raise OSError("killed")
            write_whole(path, data, mode)

        monkeypatch.setattr(repository_module, "write_whole", write)

    desk = Desk(tmp_path)
    for words in (("init",), ("delegate", "site-a/arms")):
        killed_after(writes)
        done = desk.run(*words)
        monkeypatch.undo()
        again = desk.run(*words)
        assert (
            again.exit_code == 0 or "has a repository" in again.output or "delegated already" in again.output
        )
        assert done.exit_code == 1 or again.exit_code == 1
    desk.good("sign", "--root")
    desk.good("add", "site-a/arms", str(desk.robot))
    desk.good("publish", str(tmp_path / "served"))
    assert list(read_publication(tmp_path / "served").bundles) == ["site-a/arms/1.tar"]


def test_a_wrong_passphrase_signs_nothing(desk: Desk) -> None:
    wrong = desk.folder / "wrong"
    wrong.write_text("another passphrase\n")
    done = desk.run("add", "site-a/arms", str(desk.robot), secret=wrong)
    assert done.exit_code == 1
    assert "passphrase is wrong" in done.output
    for key in (desk.folder / "repository" / "keys").iterdir():
        assert "ENCRYPTED" in key.read_text()
        assert key.stat().st_mode & 0o077 == 0
