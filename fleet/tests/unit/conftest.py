from tests.support.autojump import anyio_backend

__all__ = ["anyio_backend"]  # a fixture
