"""Words of users in figures: names of machines, joints, tasks and channels as they are."""

_LONG = 80  # characters


def plain(text: str) -> str:
    r"""A text that matplotlib sets as it stands.

    It would read what is between two $ as mathematics (and refuse `$\bad$`), and leave out of
    legends what begins with an underscore.
    """
    shown = "".join(c if c.isprintable() else " " for c in text)
    shown = shown if len(shown) <= _LONG else f"{shown[: _LONG - 1]}…"
    shown = shown.replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown
