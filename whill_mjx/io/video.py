"""Videos: H.264 by ffmpeg, which runs as a process of its own, and GIF."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from whill_mjx.io.folders import whole_file

VIDEOS = (".mp4", ".gif")
"""Endings of videos that `write_video` writes."""
EVEN = 2
"""Width and height of an H.264 video are multiples of it; other frames are cut."""


def find_ffmpeg() -> str:
    """Path of the ffmpeg program; ImportError where it is not installed."""
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()


def write_h264(path: Path, frames: Iterable[np.ndarray], rate_hz: float, quality: int = 20) -> Path:
    """Write frames (H, W, 3) uint8 of one size as a video, whole or not at all.

    The process is started without a function between fork and exec: Python would fork this one, threads of JAX and
    all, to call it.

    Args:
        path: ends in .mp4.
        frames: at least one.
        rate_hz: frames per second.
        quality: constant rate factor of x264; lower is better and larger.
    """
    frames = iter(frames)
    first = next(frames)
    height, width = (size - size % EVEN for size in first.shape[:2])
    with whole_file(path) as temporary:
        command = [
            find_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
            "-r", f"{rate_hz:g}", "-i", "-", "-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", str(quality),
            "-movflags", "+faststart", str(temporary),
        ]  # fmt: skip
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdin is not None and process.stderr is not None
            try:
                for frame in (first, *frames):
                    process.stdin.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
                process.stdin.close()
            except BrokenPipeError:
                pass  # its last words say why
            words = process.stderr.read().decode(errors="replace").strip()
        if process.returncode:
            raise OSError(f"{path}: ffmpeg ended with code {process.returncode}: {words or 'no reason given'}. "
                          "Free some space, or leave the videos out (--videos 0).")
    return path


def write_video(path: Path, frames: list[np.ndarray], scale: int, rate: float) -> None:
    """Write frames (H, W, 3) uint8 as a video of `rate` frames per second, whole or not at all."""
    large = [frame.repeat(scale, 0).repeat(scale, 1) for frame in frames]
    if path.suffix != ".gif":
        write_h264(path, large, rate)
        return
    import imageio.v2 as imageio

    with whole_file(path) as temporary:
        imageio.mimwrite(temporary, large, duration=1000 / rate, loop=0)  # type: ignore[arg-type]
