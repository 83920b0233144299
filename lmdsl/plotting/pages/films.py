"""Frames become files: a GIF by Pillow, which matplotlib needs too, or an MP4 by ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from importlib import import_module
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import LmdslError, MissingDependency, plain_text

PALETTE = 256  # colours of a GIF
APART = (48, 24, 16, 12, 8, 6, 4, 2, 1)  # how much colours of a palette differ, from the first on
CANDIDATES = 5_000  # commonest colours that may get into a palette
REST = 1.5  # seconds for which the last frame stands

Pixels = NDArray[np.uint8]  # (height, width, 3)


def gif(frames: list[Pixels], fps: int) -> bytes:
    """Return frames as a GIF that begins again and again."""
    from PIL import Image

    colours = palette(frames)
    pages = []
    for index in indexed(frames, colours):
        page = Image.fromarray(index)
        page.putpalette(colours.tobytes())
        pages.append(page)
    each = max(round(1000 / fps), 10)
    times = [each] * (len(pages) - 1) + [round(1000 * REST)]
    content = BytesIO()
    pages[0].save(
        content, format="GIF", save_all=True, append_images=pages[1:], duration=times, loop=0
    )
    return content.getvalue()


def palette(frames: list[Pixels]) -> Pixels:
    """Return one palette for all frames, (256, 3) at most, from three of them.

    Of the commonest colours those come first that differ much; of like ones the commoner.
    """
    some = np.concatenate([_codes(frames[i * (len(frames) - 1) // 2]).ravel() for i in range(3)])
    found, count = np.unique(some, return_counts=True)
    common = _colours(found[np.argsort(-count, kind="stable")][:CANDIDATES])
    kept, distance = [0], np.abs(common - common[0]).sum(axis=1)
    for apart in APART:
        while len(kept) < PALETTE and (far := distance >= apart).any():
            kept.append(int(far.argmax()))
            np.minimum(distance, np.abs(common - common[kept[-1]]).sum(axis=1), out=distance)
    return common[kept].astype(np.uint8)


def indexed(frames: list[Pixels], colours: Pixels) -> list[NDArray[np.uint8]]:
    """Return frames as indices of the nearest colours."""
    from scipy.spatial import KDTree

    tree, known = KDTree(colours.astype(float)), np.zeros(2**24, dtype=np.bool_)
    nearest, found = np.zeros(2**24, dtype=np.uint8), []
    for frame in frames:
        code = _codes(frame)
        new = np.unique(code[~known[code]])
        if len(new):
            nearest[new], known[new] = tree.query(_colours(new).astype(float))[1], True
        found.append(nearest[code])
    return found


def _codes(frame: Pixels) -> NDArray[np.int32]:
    """Return colours as numbers of 24 bits."""
    red, green, blue = np.moveaxis(frame.astype(np.int32), -1, 0)
    return np.asarray((red << 16) | (green << 8) | blue)


def _colours(codes: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return colours, (n, 3), of numbers of 24 bits."""
    return np.stack([codes >> 16, (codes >> 8) & 255, codes & 255], axis=-1)


def mp4(frames: list[Pixels], fps: int, writer: str) -> bytes:
    """Return frames as an MP4 that browsers play; sides are even numbers of pixels.

    LmdslError: the writer fails.
    """
    height, width = (2 * (side // 2) for side in frames[0].shape[:2])
    last = [frames[-1]] * round(REST * fps)
    raw = b"".join(frame[:height, :width].tobytes() for frame in [*frames, *last])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        command = [
            writer, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s",
            f"{width}x{height}", "-r", str(fps), "-i", "-", "-an", "-pix_fmt", "yuv420p",
            "-movflags", "+faststart", "-y", str(path),
        ]  # fmt: skip
        done = subprocess.run(command, input=raw, capture_output=True, check=False)
        if done.returncode or not path.exists():
            said = plain_text(done.stderr[-200:].decode("utf-8", "backslashreplace"))
            raise LmdslError(f"ffmpeg wrote no film: {said}; write a .gif instead")
        return path.read_bytes()


def ffmpeg() -> str:
    """Return the ffmpeg that is installed; MissingDependency where there is none."""
    found = shutil.which("ffmpeg")
    if found is None:
        try:  # a package that brings one
            found = str(import_module("imageio_ffmpeg").get_ffmpeg_exe())
        except (ImportError, RuntimeError):
            raise MissingDependency("an .mp4 needs ffmpeg: install it, or write a .gif") from None
    return found
