"""Check a bundle on the operator's machine as robots do, except for the checks that need a robot."""

import ipaddress

from appliance.formats.bundle_archive import BundleContents
from appliance.hosts.hosts_file import DeclaredHostsError, parse_declared
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.policy_findings import PolicyError
from appliance.specifications.checking import check
from appliance.specifications.specification_files import Sources, SpecificationsRefusedError


def findings_of(contents: BundleContents) -> list[str]:
    """Return the errors of a bundle's contents.

    The policy may only name hosts whose addresses hosts.yaml declares. The site's signatures are left to the robots.
    """
    findings: list[str] = []
    hosts = {}
    try:
        declared = parse_declared(contents.hosts, "hosts.yaml")
        hosts = {
            name: ipaddress.ip_address(host.address)
            for name, host in declared.items()
            if host.address is not None
        }
    except DeclaredHostsError as error:
        findings.append(str(error))
    try:
        known = PolicyContext(hosts=hosts, cases_file="policy.ini.tests.yaml", cases=contents.cases)
        judge(contents.policy, "policy.ini", known).accept()
    except PolicyError as error:
        findings += [str(finding) for finding in error.findings]
    try:
        check(Sources(contents.files, contents.definitions, contents.signatures), [])
    except SpecificationsRefusedError as error:
        findings += error.findings
    return findings
