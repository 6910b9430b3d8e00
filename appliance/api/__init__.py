"""REST: a separate process that is linked to control and reads the audit log.

It can neither make tokens nor write the audit log, and control checks rights again. So RVMaster continues when
this process is compromised.
"""
