"""Image files: validated reading of PNG and JPEG, encoding of PNG."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from perception.errors import InvalidInputError
from perception.io.files import read_bytes

MAX_IMAGE_SIDE = 8192  # [px]
MAX_IMAGE_BYTES = 256 * 2**20  # more than the pixels of the largest colour image
DEPTH_MODES = ("I;16", "I;16B", "I")  # Pillow's modes of 16-bit grey images


def read_image(folder: Path, name: str, modes: tuple[str, ...], wanted: str) -> np.ndarray:
    """Read a PNG or JPEG file and check that it is complete, of the wanted pixel type, and inside the folder.

    Args:
        folder: Folder that must contain the file, also after following links.
        name: Path of the file relative to the folder; the suffix decides between PNG and JPEG.
        modes: Accepted pixel types, as Pillow's modes.
        wanted: The accepted types in words, for the message.

    Raises:
        InvalidInputError: The message names the file, the problem and the remedy.
    """
    path = folder / name
    kind = "PNG" if path.suffix == ".png" else "JPEG"
    try:
        if not path.exists():
            raise InvalidInputError(f"{path} is missing: add it, or remove it from the list of images")
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InvalidInputError(f"{path} leads out of the scan folder: copy the image into it")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            data = read_bytes(path, MAX_IMAGE_BYTES)
            header = Image.open(io.BytesIO(data), formats=(kind,))
            mode, size = header.mode, header.size
            if mode not in modes:
                raise InvalidInputError(f"{path} must be {wanted}, its pixels are of type '{mode}'")
            if max(size) > MAX_IMAGE_SIDE:
                raise InvalidInputError(f"{path} is {size[0]}x{size[1]}; at most {MAX_IMAGE_SIDE} px a side")
            header.verify()  # checksums of every chunk
            pixels = np.asarray(Image.open(io.BytesIO(data), formats=(kind,)))
    except InvalidInputError:
        raise
    except UnidentifiedImageError:  # its message names a buffer in memory
        raise InvalidInputError(
            f"{path} is not a readable {kind} (no {kind} header): record or copy it again"
        ) from None
    except Exception as error:  # decoders raise many types, such as struct.error and SyntaxError
        raise InvalidInputError(
            f"{path} is not a readable {kind} ({error}): record or copy it again"
        ) from None
    return pixels


def png_bytes(image: np.ndarray) -> bytes:
    """Encode an image as PNG: (H, W, 3) uint8, or (H, W) uint8 or uint16."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()
