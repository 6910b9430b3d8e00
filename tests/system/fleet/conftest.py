from fleet.tests.system.conftest import cluster, database, make_robot, shared, site

__all__ = ["cluster", "database", "make_robot", "shared", "site"]  # fixtures
