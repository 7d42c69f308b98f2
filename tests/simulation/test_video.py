"""Videos: what was written can be read back, and no half file is left."""

import resource

import imageio.v2 as imageio
import numpy as np
import pytest

from marl_handover.errors import CannotWrite, InvalidSetting, MissingFile, MissingProgram
from marl_handover.simulation import video
from marl_handover.simulation.video import FrameClock, Video


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_has_its_frames_and_size(tmp_path, suffix):
    with Video(tmp_path / f"a{suffix}", 10) as video:
        for shade in (0, 120, 240):
            video.add(np.full((36, 64, 3), shade, np.uint8))
    frames = [*imageio.get_reader(tmp_path / f"a{suffix}").iter_data()]
    assert [frame.shape[:2] for frame in frames] == [(36, 64)] * 3
    np.testing.assert_allclose([frame[..., 0].mean() for frame in frames], (0, 120, 240), atol=6)
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def test_an_error_leaves_no_file(tmp_path):
    def fail_half_way():
        with Video(tmp_path / "a.gif", 10) as video:
            video.add(np.zeros((36, 64, 3), np.uint8))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert not list(tmp_path.iterdir())


def noise(path, frames=40):
    """A film that does not pack well."""
    draw = np.random.default_rng(0)
    with Video(path, 10) as film:
        for _ in range(frames):
            film.add(draw.integers(0, 256, (120, 160, 3), np.uint8))


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize("room_bytes", [0, 30_000, 200_000])
def test_without_room_there_is_no_film_and_its_name_is_said(tmp_path, suffix, room_bytes):
    path = tmp_path / f"film{suffix}"
    path.write_bytes(b"old")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, usual[1]))
    try:
        with pytest.raises(CannotWrite, match=f"film{suffix} cannot be written: (File too large|ffmpeg ended with)") as full:
            noise(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert full.value.exit_status == 1
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    noise(path)
    assert path.stat().st_size > 200_000


def test_an_encoder_that_gives_up_is_no_end_of_a_film(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "get_ffmpeg_exe", lambda: "/bin/false")
    with pytest.raises(CannotWrite, match="film.mp4 cannot be written: ffmpeg ended with 1: it said nothing"):
        noise(tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_without_ffmpeg_it_is_said_what_is_missing(tmp_path, monkeypatch):
    def none():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(video, "get_ffmpeg_exe", none)
    with pytest.raises(MissingProgram, match="needs the program ffmpeg"):
        noise(tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_bad_paths_are_refused(tmp_path):
    with pytest.raises(InvalidSetting, match=r"\.mp4 or \.gif"):
        Video(tmp_path / "a.avi", 10)
    with pytest.raises(MissingFile, match="nowhere"):
        Video(tmp_path / "nowhere" / "a.mp4", 10)


@pytest.mark.parametrize(("fps", "frames"), [(25, 50), (50, 100), (12.5, 25), (30, 60)])
def test_the_clock_gives_the_frames_of_two_seconds(fps, frames):
    clock = FrameClock(fps, 0.02)
    assert sum(clock.due() for _ in range(100)) == frames
