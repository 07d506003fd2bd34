"""The picture under a drawing: an image, or a page of a PDF."""

import os
from io import BytesIO
from pathlib import Path
from typing import Any

from crane.common.errors import CraneError, InputError, warn
from crane.common.optional_libraries import import_optional_library
from crane.common.package_search import read_plain_file
from crane.view.draw.drawing_file import DrawingFile

_MAX_SIZE = 50_000_000  # of a file [bytes]
_PAGE_PIXELS = 3000  # of the longer side of a page


def read_picture(file: Path, number: int = 1) -> bytes:
    """Return a picture as a browser shows it.

    Args:
        file: PNG, JPEG or PDF.
        number: Page of a PDF, from 1.

    Raises:
        InputError: The file is no picture, cannot be read, has no such page, or pypdfium2
            is not installed.
    """
    from matplotlib.image import imread, imsave

    png = BytesIO()
    try:
        if not (data := read_plain_file(file, _MAX_SIZE)).startswith(b"%PDF"):
            count = min(imread(BytesIO(data), format="any").ndim, 1)
        else:
            pdfium = import_optional_library("pypdfium2", "a picture from a PDF")
            count = len(document := pdfium.PdfDocument(data))
    except InputError:
        raise
    except Exception as error:  # the libraries have several
        reason = getattr(error, "strerror", None) or "is no picture that can be read"
        raise InputError(f"{file}: {reason}, give a PNG, JPEG or PDF") from None
    if not 1 <= number <= count:
        raise InputError(f"{file}: has no page {number}, give 1 to {count:d}")
    if not data.startswith(b"%PDF"):
        return data
    scale = _PAGE_PIXELS / max(document[number - 1].get_size())
    bitmap = document[number - 1].render(scale=scale, rev_byteorder=True)
    imsave(png, bitmap.to_numpy(), format="png")
    return png.getvalue()


def place_picture(
    file: DrawingFile, source: Path | None, picture: Path | None, page: int
) -> tuple[dict[str, Any], bytes]:
    """Return what the page of a drawing shows at first, and its picture, empty without one.

    Args:
        file: The drawing.
        source: The machine file that it was read from.
        picture: A picture, if not the one that the drawing has.
        page: Page of a PDF.
    """
    known: Any = file.data.get("drawing", {}).get("picture")
    model, content, placement = dict(file.data), b"", dict[str, Any]()
    if picture is not None:
        content, placement = read_picture(picture, page), {"page": page} if page != 1 else {}
    elif known is not None and source is not None:
        try:
            picture, placement = source.parent / known["file"], known
            content = read_picture(picture, int(known.get("page", 1)))
        except (CraneError, OSError, TypeError, KeyError, ValueError) as error:
            warn(f"{source}: the drawing's picture is left out: {error}")
    if content and picture is not None:
        name = os.path.relpath(picture, file.path.parent)
        placement = (known if known and known.get("file") == name else placement) | {"file": name}
        model["drawing"] = model.get("drawing", {}) | {"picture": placement}
    return {"model": model, "file": file.path.name, "hasPicture": bool(content)}, content
