"""Words of users in figures: names of machines, joints, tasks and channels as they are."""

_MAX_LENGTH = 80  # characters


def escape_label(text: str) -> str:
    r"""A text that matplotlib sets as it stands.

    It would read what is between two $ as mathematics (and refuse `$\bad$`), and leave out of
    legends what begins with an underscore.
    """
    shortened = text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 1]}…"
    shortened = escape_text(shortened)
    return f" {shortened}" if shortened.startswith("_") else shortened


def escape_text(text: str) -> str:
    """The same of a text of any length that is in no legend."""
    printable = "".join(c if c.isprintable() or c == "\u00a0" else " " for c in text)
    return printable.replace("$", r"\$")
