"""Tables as plain text."""


def columns(rows: list[tuple[str, ...]]) -> str:
    """Words in columns, the first one to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0])]
            + [word.rjust(width) for word, width in zip(row[1:], widths[1:], strict=True)]
        ).rstrip()
        for row in rows
    )
