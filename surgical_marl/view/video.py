"""Videos of frames: an mp4, or a gif where ffmpeg cannot run; an animated webp for pages."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import subprocess
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

QUALITY = 55
"""Quality of a webp, from 0 to 100."""

Frames = Iterable[NDArray[np.uint8]]


def write_video(path: str | os.PathLike[str], frames: Frames, fps: float, small: bool = False) -> Path:
    """Write frames [height, width, 3] as a video and return its path.

    A path with `.gif` or `.webp` becomes that. Any other becomes an mp4, or a gif beside it where ffmpeg cannot run;
    `small` makes an mp4 a third smaller and takes longer. The file is written completely or not at all.
    """
    if not fps > 0:
        raise ValueError(f"a video of {fps!r} frames a second never moves on: use more than 0")
    path = Path(path)
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"no frames to write to {str(path)!r}: a video needs 1 or more")
    if path.suffix not in (".gif", ".webp"):
        path = path.with_suffix(".mp4" if ffmpeg_runs() else ".gif")
    mp4 = partial(_write_mp4, small=small)
    writers: dict[str, Callable[..., None]] = {".gif": _write_gif, ".webp": _write_webp, ".mp4": mp4}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        writers[path.suffix](part, first.shape, itertools.chain([first], frames), fps)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def ffmpeg_runs() -> bool:
    """Return whether an mp4 can be written here."""
    try:
        import imageio_ffmpeg

        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-version"]
        return subprocess.run(command, capture_output=True, timeout=20).returncode == 0
    except (ImportError, OSError, RuntimeError, subprocess.TimeoutExpired):
        return False


def _write_gif(path: Path, shape: tuple[int, ...], frames: Frames, fps: float) -> None:
    # Gif counts time in hundredths of a second, and viewers slow down below two of them.
    # In memory first: where a disk is full, the writer would try again when it is freed, and print that error.
    writer: Any
    whole = io.BytesIO()
    with imageio.get_writer(whole, format="GIF", duration=max(20.0, 1000 / fps), loop=0) as writer:
        for frame in frames:
            writer.append_data(frame)
    path.write_bytes(whole.getvalue())


def _write_webp(path: Path, shape: tuple[int, ...], frames: Frames, fps: float) -> None:
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, quality=QUALITY, method=4)


def _write_mp4(path: Path, shape: tuple[int, ...], frames: Frames, fps: float, small: bool) -> None:
    effort = "-preset veryslow -crf 23" if small else "-crf 20"
    with Mp4(path, shape, fps, f"{effort} -movflags +faststart") as film:
        for frame in frames:
            film.add(frame)


class Mp4:
    """An mp4 of H.264 that is written frame by frame: `with Mp4(...) as film: film.add(frame)`.

    It is complete after the block. An exception in the block ends the encoder, and leaves a part of a file.

    Args:
        path: of the file.
        shape: of a frame, [height, width, 3]. A side of an odd number of pixels gets one more.
        fps: frames a second.
        options: of ffmpeg for its encoder libx264.

    Raises:
        OSError: ffmpeg could not write it; raised by the end of the block.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], fps: float, options: str) -> None:
        import imageio_ffmpeg

        # Not by imageio's own writer: it forks with a Python hook, which threads of JAX may deadlock.
        source = f"-f rawvideo -pix_fmt rgb24 -s {shape[1]}x{shape[0]} -r {fps:g} -i -"
        even = "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2"
        target = f"{even} -c:v libx264 {options} -pix_fmt yuv420p"
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *source.split(), *target.split()]
        self._path = path
        self._ffmpeg = subprocess.Popen(
            [*command, str(path)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # in a session of its own, so that ffmpeg finishes its file after Ctrl-C
        )

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Write a frame [height, width, 3]."""
        assert self._ffmpeg.stdin
        with contextlib.suppress(BrokenPipeError):  # ffmpeg failed; its message is shown at the end
            self._ffmpeg.stdin.write(np.ascontiguousarray(frame).data)

    def __enter__(self) -> Mp4:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        with self._ffmpeg as ffmpeg:
            if kind is not None:
                ffmpeg.kill()
                return
            assert ffmpeg.stdin and ffmpeg.stderr
            with contextlib.suppress(BrokenPipeError):
                ffmpeg.stdin.close()
            complaint = ffmpeg.stderr.read().decode(errors="replace")
        if ffmpeg.returncode:
            raise OSError(f"ffmpeg could not write {str(self._path)!r}: {' '.join(complaint.split())}")
