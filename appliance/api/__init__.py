"""REST: a separate process that is linked to control and reads the audit log.

The process parses the requests of browsers and scripts, authenticates tokens, and sends typed requests to control.
Control checks rights again, and this process can neither make tokens nor write the audit log. So RVMaster continues
when this process is flooded, killed or compromised.
"""
