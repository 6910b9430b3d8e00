"""The Ansible role and the cloud-init example, read by the programs they are for, in a Debian that is made for it."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.debian_base import ROOT, make_base

pytestmark = pytest.mark.timeout(1200)  # the Debian is made


@pytest.fixture(scope="module")
def debian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A tree with both programs and the examples."""
    tree = make_base(tmp_path_factory.mktemp("debian") / "tree", ["ansible-core", "cloud-init"])
    shutil.copytree(ROOT / "examples", tree / "examples")
    yield tree
    shutil.rmtree(tree)


def run(tree: Path, *command: str) -> str:
    """What a program in the tree says; it must succeed. It gets a /proc of its own."""
    script = 'mount -t proc proc "$1/proc"; tree=$1; shift; exec chroot "$tree" "$@"'
    done = subprocess.run(
        ["unshare", "--mount", "--propagation", "private", "sh", "-euc", script, "sh", str(tree), *command],
        capture_output=True,
        text=True,
        env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LC_ALL": "C.UTF-8"},
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_ansible_reads_the_role(debian: Path) -> None:
    """Every task is of a module that there is, with parameters that are a task's."""
    said = run(debian, "ansible-playbook", "--syntax-check", "-i", "robots,", "/examples/ansible/site.yml")
    assert "playbook: /examples/ansible/site.yml" in said
    listed = run(debian, "ansible-playbook", "--list-tasks", "-i", "robots,", "/examples/ansible/site.yml")
    assert listed.count("rosrv :") >= 7


def test_cloud_init_knows_every_key(debian: Path) -> None:
    """By its own schema."""
    said = run(debian, "cloud-init", "schema", "--config-file", "/examples/cloud-init/user-data.yaml")
    assert "Valid" in said
