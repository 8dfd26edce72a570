"""Films of environment 0, without a screen."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pace_actuators.files import replacing

_ENCODE = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart")


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write a film: ``.mp4`` with ffmpeg, ``.gif`` with Pillow.

    Args:
        path: The file.
        frames: Pictures (height, width, 3) uint8.
        fps: Pictures per second.

    Raises:
        ValueError: If the ending is another, there are no frames, or no encoder.
    """
    path = Path(path)
    check_video_path(path)
    if not frames:
        raise ValueError(f"There are no pictures to write to {path}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    with replacing(path) as part:
        write(part, frames, fps)


def check_video_path(path: str | Path) -> None:
    """Refuse, before anything is drawn, what :func:`write_video` could not write."""
    suffix = Path(path).suffix
    if suffix not in (".mp4", ".gif"):
        raise ValueError(f"The video {path} ends with {suffix!r}, expected .mp4 or .gif.")
    if suffix == ".mp4" and _ffmpeg() is None:
        raise ValueError(
            f"{path} needs ffmpeg, which was not found. Install it, or `pip install imageio-ffmpeg` "
            "(extra: video), or write a .gif."
        )


def _ffmpeg() -> str | None:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        return shutil.which("ffmpeg")
    return get_ffmpeg_exe()


def _write_gif(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    from PIL import Image

    pictures = [Image.fromarray(frame).quantize(128) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0)


def _write_mp4(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    height, width = frames[0].shape[:2]
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-")
    command = [str(_ffmpeg()), "-y", "-loglevel", "error", *raw, *_ENCODE, str(path)]
    done = subprocess.run(command, input=b"".join(f.tobytes() for f in frames), capture_output=True, check=False)
    if done.returncode:
        raise ValueError(f"ffmpeg could not write {path}: {done.stderr.decode(errors='replace').strip()}")
