"""A number with its noun in the right form, for texts that people read."""


def counted(number: int, one: str, several: str = "") -> str:
    """Return `1 element` or `2 elements`; with a verb, give both forms."""
    return f"{number} {one}" if number == 1 else f"{number} {several or f'{one}s'}"
