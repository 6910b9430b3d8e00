"""REST: a process of its own that is linked to control and reads the audit log.

It parses the requests of browsers and scripts, authenticates tokens, and passes on typed requests. Control checks
rights again, and this process can neither make tokens nor write the audit log. So RVMaster continues when this process
is flooded, killed or compromised.
"""
