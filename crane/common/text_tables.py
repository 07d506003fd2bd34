"""Tables as plain text."""

from collections.abc import Sequence


def format_table(rows: Sequence[Sequence[str]], left_aligned: Sequence[int] = (0,)) -> list[str]:
    """Lines of a table whose columns are as wide as what is in them, two blanks between.

    Args:
        rows: Cells, as many in each row.
        left_aligned: Columns that are aligned left, the others right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(width) if i in left_aligned else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines
