"""Tests of `rosrv protect` as a verb of the command."""

from typer.testing import CliRunner

from appliance.cli.main import app


def test_the_file_is_printed() -> None:
    """`rosrv protect` prints a file that nft reads, with the appliance's address and the range."""
    result = CliRunner().invoke(app, ["protect", "--appliance", "192.168.1.20", "--ports", "40000-40099"])
    assert result.exit_code == 0
    assert result.stdout.startswith("#!/usr/sbin/nft -f\n")
    assert "ip saddr { 192.168.1.20 } accept" in result.stdout


def test_the_help_has_examples_and_says_how_to_keep_it() -> None:
    """The help shows the commands to use, and what to do so that the rules outlive a boot."""
    text = CliRunner().invoke(app, ["protect", "--help"]).stdout
    for words in ("--apply", "--check 192.168.1.10", "systemctl enable --now nftables"):
        assert words in text
