from tests.unit.audit.conftest import MakeLog, Notary, key, make_log, notary, path

__all__ = ["MakeLog", "Notary", "key", "make_log", "notary", "path"]  # fixtures and their types
