"""A number with its noun in the right form, for texts of every process."""


def counted(number: int, one: str, several: str = "") -> str:
    """Return `1 host` or `2 hosts`; with a verb, give both forms: `host is`, `hosts are`."""
    return f"{number} {one}" if number == 1 else f"{number} {several or f'{one}s'}"
