"""Numbers read from texts: digits 0 to 9, a point and an exponent, in every file and option.

Python also reads other scripts' digits and underscores between digits (1_000); tables of numbers
do not, and a number shall mean the same everywhere.
"""


def parse_float(text: str) -> float:
    """The number that a text is.

    Raises:
        ValueError: It is none.
    """
    check_digits(text)
    return float(text)


def check_digits(text: str) -> None:
    """Check that a text has no digits and separators that only Python reads.

    Raises:
        ValueError: It has.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"'{text}' is not a number")
