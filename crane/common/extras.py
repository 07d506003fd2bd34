"""What does not come with the package by itself."""


def how(extra: str) -> str:
    """How to install an extra of pyproject.toml, from the repository.

    The package is on no index, and whoever registers its name there would be installed: the name
    is not told.
    """
    return f"install it in the repository's folder: pip install '.[{extra}]'"
