"""Monitors for operators: `rosrv monitor` and the routes of `/v1/monitors`."""
