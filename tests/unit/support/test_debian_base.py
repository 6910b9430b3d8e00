from tests.support.debian_base import apt_settings, debian_sources, pip_settings

TARGETS = """\
http://mirror.example/debian/ bookworm main Debian
http://mirror.example/debian/ bookworm contrib Debian
http://mirror.example/debian-security/ bookworm-security main Debian
http://mirror.example/debian/ trixie main Debian
https://packages.example/tool nodistro main Somebody
"""


def test_only_the_suite_and_its_updates_are_used() -> None:
    assert debian_sources(TARGETS, "bookworm") == [
        "deb http://mirror.example/debian/ bookworm contrib main",
        "deb http://mirror.example/debian-security/ bookworm-security main",
    ]


def test_a_machine_without_the_suite_has_no_lines_for_it() -> None:
    assert debian_sources(TARGETS, "sid") == []


def test_apt_fetches_through_the_machines_proxy() -> None:
    told = (
        'Acquire::http::Proxy "http://apt-proxy.example:3142";\nAcquire::Languages "none";\nAPT::Color "1";\n'
    )
    assert apt_settings(told, {"http": "http://other.example:1"}) == (
        'Acquire::http::Proxy "http://apt-proxy.example:3142";\n'
    )
    assert (
        apt_settings("", {"http": "http://proxy.example:1"})
        == 'Acquire::http::Proxy "http://proxy.example:1";\n'
    )


def test_pip_gets_only_indexes_that_the_tree_can_reach() -> None:
    listed = (
        "global.extra-index-url='file:///srv/simple https://pypi.example/simple'\n"
        "global.find-links='/srv/wheels'\n:env:.index-url='https://mirror.example/simple'\n"
    )
    assert pip_settings(listed) == (
        "[global]\ncert = /etc/ssl/certs/ca-certificates.crt\n"
        "extra-index-url = https://pypi.example/simple\nindex-url = https://mirror.example/simple\n"
    )
