"""The hosts that come through tunnels: their table, certificates, enrolment and tunnels."""
