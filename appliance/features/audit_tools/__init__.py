"""The audit log for operators: `rosrv audit` and the routes of `/v1/audit`."""
