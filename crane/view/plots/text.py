"""Words of users in figures: names of machines, joints, tasks and channels as they are."""

_LONG = 80  # characters


def plain(text: str) -> str:
    r"""A text that matplotlib sets as it stands.

    It would read what is between two $ as mathematics (and refuse `$\bad$`), and leave out of
    legends what begins with an underscore.
    """
    shown = text if len(text) <= _LONG else f"{text[: _LONG - 1]}…"
    shown = literal(shown)
    return f" {shown}" if shown.startswith("_") else shown


def literal(text: str) -> str:
    """The same of a text of any length that is in no legend."""
    shown = "".join(c if c.isprintable() or c == "\u00a0" else " " for c in text)
    return shown.replace("$", r"\$")
